"""Fuzz targets of all modules, by name."""

from . import dataset_targets, message_targets, run_folder_targets, user_input_targets

TARGETS = {
    str(target): target
    for module in (message_targets, dataset_targets, run_folder_targets, user_input_targets)
    for target in module.TARGETS
}
