"""Finished runs: the folders that `ldo run` and `Slam.save` write."""

from functools import cached_property
from os import PathLike
from pathlib import Path

from ldo_service.geometry import Camera, Trajectory
from ldo_service.runs.export import ExportFormat, Up, export_map
from ldo_service.runs.finished import MapFolder, newest_map
from ldo_service.runs.records import OBJECTS, read_objects

from .arrays import read_only
from .maps import FoundObject, Map, find

FilePath = str | PathLike[str]


class Run:
    """A finished run, opened by `Run.open`. Files are read when they are needed.

    Attributes:
        folder: Folder of the run.
    """

    def __init__(self, folder: Path, source: MapFolder) -> None:
        self.folder, self._source = folder, source

    @staticmethod
    def open(folder: FilePath, *, online: bool = False) -> "Run":
        """Open the folder of a run.

        Args:
            folder: The folder.
            online: True opens the map and the poses from before the refinement. False opens the
                refined ones if the run was refined.

        Raises:
            DataError: The folder has no map.
        """
        path = Path(folder).expanduser()
        return Run(path, MapFolder(path) if online else newest_map(path))

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @property
    def camera(self) -> Camera | None:
        """Rectified camera of the keyframes; None without keyframes."""
        viewpoints = self._source.viewpoints()
        return viewpoints[0].camera if viewpoints else None

    @cached_property
    def map(self) -> Map:
        """The map, which is read at the first access and kept in memory.

        Raises:
            DataError: A file is damaged.
        """
        rows, semantics = self._source.gaussians(), self._source.semantics()
        labels, names = (semantics.labels, semantics.names) if semantics else (None, ())
        return Map(rows, labels, names, self.camera)

    def trajectory(self) -> Trajectory:
        """Return T_map_camera of all frames with a pose in the map.

        Raises:
            DataError: The file of the trajectory is damaged.
        """
        return read_only(self._source.trajectory())

    def objects(self, text: str | None = None) -> list[FoundObject]:
        """Return the objects of the map.

        Args:
            text: Name or synonym of the objects; None for all objects.

        Returns:
            The objects that match, best match first; empty if there are none.

        Raises:
            DataError: A file is damaged.
        """
        has_objects = (self._source.folder / OBJECTS).is_file()
        objects = read_objects(self._source.folder) if has_objects else None
        return find(objects, text, self.trajectory().T_world_camera)

    def export(
        self,
        format: ExportFormat,
        out: FilePath,
        *,
        voxel_m: float | None = None,
        up: Up = "-y",
        heights_m: tuple[float, float] = (-0.5, 0.5),
        overwrite: bool = False,
    ) -> Path:
        """Write the map or the trajectory for other programs, as `ldo export` does.

        Args:
            format: ply, splat or spz for the Gaussians; tum or csv for the trajectory; mesh or
                occupancy for planners.
            out: File to write.
            voxel_m: Side of a voxel, meters, for mesh and occupancy; None for the default.
            up: Axis of the map that points up, for the floor plan that occupancy also writes.
            heights_m: Lowest and highest height of the voxels in this floor plan, meters above the
                first camera.
            overwrite: True replaces an existing file.

        Returns:
            Path of the written file.

        Raises:
            ConfigError: The file exists, is an output of the run, or cannot be written.
            DataError: The map has no surface.
        """
        path = Path(out).expanduser()
        export_map(
            self._source,
            format,
            path,
            run=self.folder,
            voxel_m=voxel_m,
            up=up,
            heights_m=heights_m,
            overwrite=overwrite,
        )
        return path
