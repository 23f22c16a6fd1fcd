"""Everything that reads what strangers made."""

from . import dataset_targets, message_targets, run_folder_targets, user_input_targets

TARGETS = {
    str(target): target
    for room in (message_targets, dataset_targets, run_folder_targets, user_input_targets)
    for target in room.TARGETS
}
