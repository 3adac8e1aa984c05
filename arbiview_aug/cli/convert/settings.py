"""Settings of a conversion, and the checks before any work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from arbiview_aug.atomic_io import checksum, is_part
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.drive import Neighbours, Recording
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.datasets.motion_depth import WithMotionDepth
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.datasets.registry import open_data
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.favs.config import Quality
from arbiview_aug.generator import Generator
from arbiview_aug.generator.fillers import Holes
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import RenderPath

FOLDER = "conversion"
"""Subfolder of an output with manifest, provenance and report."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Everything that decides the bytes of an output, and where it comes from and goes to.

    Attributes:
        root: The source's folder.
        kind: Of the source; None for whichever there is.
        version: nuScenes' folder of tables; None for the usual one.
        target: The rig to render, in its own ego frame.
        output: Where to write.
        path: As for ``RigRetarget``.
        holes: As for ``RigRetarget``.
        generator: Folder of the generator, for ``path="diffusion"``; None for the package's own.
        steps: Of the generator; None for its own number.
        quality: As for ``RigRetarget``.
        surface: As for ``RigRetarget``.
        size: (h, w) of every view; None for the target's own.
        fit: How the target's cameras come to ``size``, as for ``RigRetarget``.
        reduce: Decode the source's images at 1, 1/2 or 1/4 of their size.
        neighbours: How many other frames of the drive in each direction may fill holes; 0 for none.
        motion_depth: Folder of the ``depth`` command's files, for ``surface="motion"``; None finds depth anew, from the
            neighbours.
        suffix: Of the images: ``.jpg`` at quality 96 and 4:4:4, or ``.png``, which loses nothing. Masks are always PNG.
    """

    root: Path
    kind: str | None = None
    version: str | None = None
    target: Rig
    output: Path
    path: RenderPath = "favs"
    holes: Holes = "fill"
    generator: Path | None = None
    steps: int | None = None
    quality: Quality = "fast"
    surface: SurfaceName = "auto"
    size: tuple[int, int] | None = None
    fit: Fit = "crop"
    reduce: Reduce = 1
    neighbours: int = 0
    motion_depth: Path | None = None
    suffix: Literal[".jpg", ".png"] = ".jpg"

    @property
    def sized_target(self) -> Rig:
        """The target at the size of the views, in its own ego frame."""
        return self.target if self.size is None else self.target.resized(self.size, self.fit)

    def open(self) -> Recording:
        """The source.

        Raises:
            DataError: It cannot be read.
        """
        near = Neighbours(count=self.neighbours) if self.neighbours else None
        return open_data(self.root, kind=self.kind, version=self.version, reduce=self.reduce, neighbours=near)

    def samples(self, data: Recording) -> Recording | WithMotionDepth:
        """The source's samples, with depth from motion where that was found before."""
        return data if self.motion_depth is None else WithMotionDepth(data, self.motion_depth)

    def retarget(self) -> RigRetarget:
        """The transform; each process or actor makes one."""
        outputs = () if self.quality == "paper" else ("confidence",)
        return RigRetarget(
            self.target,
            path=self.path,
            holes=self.holes,
            generator=None if self.generator is None else Generator.from_pretrained(self.generator),
            steps=self.steps,
            quality=self.quality,
            surface=self.surface,
            size=self.size,
            fit=self.fit,
            outputs=outputs,
        )

    def rendering(self) -> dict[str, Any]:
        """All settings that decide the pixels, as plain data."""
        target = self.target.to_dict()
        for entry, camera in zip(target["cameras"], self.target, strict=True):
            entry["content"] = camera.content_key.hex()  # of its mask too
        names = ("path", "holes", "steps", "quality", "surface", "size", "reduce", "neighbours", "suffix")
        files = [] if self.generator is None else sorted(path for path in self.generator.iterdir() if path.is_file())
        generator = {path.name: checksum(path) for path in files}
        settings = {name: getattr(self, name) for name in names} | ({} if self.size is None else {"fit": self.fit})
        return {
            **settings,
            "motion_depth": self.motion_depth is not None,
            "generator": generator,
            "target": target,
        }


def check_target(settings: Settings, data: Recording) -> None:
    """Refuse a target that the output's format cannot hold.

    Raises:
        CalibrationError: Lenses, or the name of another sensor, in nuScenes tables.
    """
    if not isinstance(data, NuScenesDataset):
        return
    target = settings.target
    lenses = [f"{camera.name} ({camera.lens})" for camera in target if not camera.is_rectilinear]
    if lenses:
        name = target.name or "the target"
        raise CalibrationError(
            f"rig {name!r}: expected pinhole cameras, since nuScenes tables know no lenses, got {', '.join(lenses)}; "
            f"convert to Rig.undistorted(): python -c \"from arbiview_aug import load_rig; load_rig('{name}')"
            f".undistorted().save('pinhole.yaml')\" and --target pinhole.yaml; frame folders carry lenses"
        )
    taken = sorted(set(target.names) & set(data.other_channels))
    if taken:
        raise CalibrationError(
            f"rig {target.name!r}: expected cameras of other names than the sensors that are kept, got "
            f"{', '.join(taken)}; rename them in the rig file"
        )


def check_output(settings: Settings) -> None:
    """Refuse an output folder that is the source's, or somebody else's.

    Raises:
        DataError: It is the source, in it or around it; or it holds what no conversion wrote.
    """
    source, output = settings.root.resolve(), settings.output.resolve()
    if source == output or source in output.parents or output in source.parents:
        where = "the source itself" if source == output else "in it" if source in output.parents else "around it"
        raise DataError(f"--output {settings.output}: expected a folder apart from the source {source}, got {where}")
    if not output.exists():
        return
    if not output.is_dir():
        raise DataError(f"--output {settings.output}: expected a folder, got a file")
    if (output / FOLDER / "settings.json").is_file():
        return
    foreign = next((path.name for path in output.rglob("*") if not path.is_dir() and not is_part(path)), None)
    if foreign is not None:
        raise DataError(
            f"--output {settings.output}: expected an empty folder, or a conversion to go on with, got {foreign} "
            f"and no {FOLDER}/settings.json; name another folder"
        )
