"""Layouts of recordings: how a path is recognized, and how it is opened as a sequence."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from ldo_service.errors import ConfigError
from ldo_service.geometry.sequence import Sequence

from .rig import SequenceOptions

# Entry-point group in which other packages register a `Layout`.
ENTRY_POINTS = "ldo.sequences"


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of a recording: a folder or a file.

    Layouts of this package are tried before those of other packages. For example, this package
    takes every folder that contains a folder results/ as a sequence of Replica. A layout of another
    package should therefore use other names of files and folders.

    A package adds a layout by an entry point in its pyproject.toml, such as:

        [project.entry-points."ldo.sequences"]
        my_rig = "my_package:LAYOUT"

    Attributes:
        name: Name of the layout, such as "TUM RGB-D".
        files: Files that a recording has, as a text for error messages.
        matches: Function that returns whether an existing path has the layout. It checks the names
            of files, or the first bytes of a file.
        open: Function that opens a path with this layout. It raises DataError if a file is missing
            or damaged, and ConfigError if the layout does not support the options.
        has_options: True if `open` accepts the options that register the depth to the color
            camera.
        has_topics: True if `open` accepts the options that name topics.
    """

    name: str
    files: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, SequenceOptions], Sequence]
    has_options: bool = False
    has_topics: bool = False

    def open_sequence(self, path: Path, options: SequenceOptions) -> Sequence:
        """Open a path that has the layout.

        Raises:
            DataError: A file is missing or damaged.
            ConfigError: The layout does not support the options.
        """
        if not (self.has_options or options.is_default):
            raise ConfigError(
                f"the depth of {path} ({self.name}) is registered to color already. Remove "
                "dataset.register_depth and dataset.T_color_depth; in Python, remove the "
                "registration options of SequenceOptions."
            )
        if options.topics and not self.has_topics:
            raise ConfigError(
                f"{path} ({self.name}) has no topics. Remove --topic (dataset.topics)."
            )
        return self.open(path, options)


@cache
def registered_layouts() -> tuple[Layout, ...]:
    """Return the layouts of other packages, in the order of their names.

    Raises:
        ConfigError: An entry point cannot be loaded, or is not a `Layout`.
    """
    layouts = []
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        try:
            layout = point.load()
        except Exception as error:
            raise ConfigError(
                f"the entry point {point.name} = {point.value} of the group {ENTRY_POINTS} cannot "
                f"be loaded: {type(error).__name__}: {error}. Repair or remove its package."
            ) from error
        if not isinstance(layout, Layout):
            raise ConfigError(
                f"the entry point {point.name} = {point.value} of the group {ENTRY_POINTS} is a "
                f"{type(layout).__name__}, must be an ldo_service.datasets.Layout. Repair or "
                "remove its package."
            )
        layouts.append(layout)
    return tuple(layouts)
