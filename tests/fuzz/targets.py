"""Everything that reads what strangers made."""

from . import of_data_sets, of_runs, of_the_network, of_users

TARGETS = {
    str(target): target
    for room in (of_the_network, of_data_sets, of_runs, of_users)
    for target in room.TARGETS
}
