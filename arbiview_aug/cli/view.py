"""``python -m arbiview_aug view``: frames and their views by another vehicle, as a recording for Rerun's viewer."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import whole_file
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import frames_text, named_steps, output_file
from arbiview_aug.cli.evaluate import open_frames, target_rig
from arbiview_aug.datasets.image_io import encoded_image
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import views_of
from arbiview_aug.evaluate.metrics import Image, as_arrays, as_tensors
from arbiview_aug.evaluate.report.pictures import BOX, HOLE, RIG_COLOURS, box_lines, coloured, left_to_right
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import SampleKeys

_FRUSTUM_M = 0.8  # from a camera to its image in 3D
_PIXEL_CENTER = 0.5  # Rerun counts pixels from the image's corner
_LOW_M, _HIGH_M = -0.5, 3.5  # heights of points over the road, blue to red
_THIN = -1.0  # a radius in points of the screen
_SEEN, _FILLED, _BLACK, _MASKED = range(4)
_LEGEND = (
    (_SEEN, "seen by a source camera", (0, 0, 0, 0)),
    (_FILLED, "filled: no camera saw it", (*HOLE, 255)),
    (_BLACK, "black: no camera saw it", (*HOLE, 255)),
    (_MASKED, "masked", (90, 90, 90, 255)),
)


def run(arguments: argparse.Namespace) -> None:
    """Write the recording."""
    path = output_file(arguments.output, [".rrd"])
    if re.search("[\ud800-\udfff]", arguments.output):
        raise DataError(f"--output {arguments.output!a}: expected a name in UTF-8, which Rerun's writer needs")
    optional_package("rerun", "viewer")  # before work starts
    chosen = None if arguments.target is None else load_rig(arguments.target)
    notes: list[str] = []
    with named_steps(notes, arguments.frames) as tick, whole_file(path) as file:
        data = open_frames(arguments, [arguments.geometry])
        first = data[0]
        target = target_rig(arguments, chosen, first["rig"])
        keys = SampleKeys(extra=() if arguments.quality == "paper" else ("confidence",))
        options = {name: getattr(arguments, name) for name in ("quality", "geometry", "holes")}
        retarget = RigRetarget(target, keys=keys, **options)
        recording = SampleRecording(Path(file.name), first["rig"], target)
        count = min(arguments.frames, len(data))
        for number in range(count):
            sample = data[number] if number else first
            tick(str(sample.get("token", number)), 1)
            recording.add(sample, retarget(sample))
        recording.close()
    for note in notes:
        print(f"note: {note}\n")
    print(f"recording: {path} ({frames_text(count)}, {path.stat().st_size / 1e6:.1f} MB)")
    print(f"open it: python -m rerun {path}")


class SampleRecording:
    """Recording of samples and their views by a target rig, written to an .rrd file frame by frame."""

    def __init__(self, path: Path, source: Rig, target: Rig) -> None:
        self._rr = optional_package("rerun", "viewer")
        self._stream = self._rr.RecordingStream("arbiview_aug")
        self._stream.save(path)
        self._log, self._frames, self._target = self._stream.log, 0, target
        self._first: dict[str, Any] = {}  # time and pose of the first frame
        self._log("/", self._rr.ViewCoordinates.FLU, static=True)
        self._log("/", self._rr.AnnotationContext(list(_LEGEND)), static=True)
        # The 3D scene next to the source's images and the target's views.
        rigs = {"source": source, "target": target}
        views = optional_package("rerun.blueprint", "viewer")
        cameras = [(self._path(side, camera), camera) for side, rig in rigs.items() for camera in rig]
        flat = [f"{path}/{name}" for path, _ in cameras for name in ("boxes", "coverage", "confidence")]
        flat += [f"{path}/image" for path, camera in cameras if not camera.is_rectilinear]
        contents = ["/ego/**", *(f"- {path}" for path in flat)]
        scene = views.Spatial3DView(origin="/ego", contents=contents, name="vehicle")

        def grid(side: str, shown: str, name: str) -> Any:
            ordered = [rigs[side][k] for k in left_to_right(rigs[side])]
            contents = [f"$origin/{layer}" for layer in (*shown.split(), "boxes")]
            places = [{"origin": self._path(side, camera), "name": camera.name} for camera in ordered]
            images = [views.Spatial2DView(contents=contents, **place) for place in places]
            return views.Grid(*images, grid_columns=min(3, len(ordered)), name=name)

        tabs = grid("target", "image coverage", "target"), grid("target", "confidence", "confidence")
        images = views.Vertical(grid("source", "image coverage", "source"), views.Tabs(*tabs))
        layout = views.Horizontal(scene, images, column_shares=[2, 3])
        self._stream.send_blueprint(views.Blueprint(layout, collapse_panels=True))

    def close(self) -> None:
        """Write the rest to the disk."""
        self._stream.disconnect()

    def _path(self, side: str, camera: Camera) -> str:
        return f"/ego/{side}/{self._rr.escape_entity_path_part(camera.name)}"

    def add(self, sample: Mapping[str, Any], out: Mapping[str, Any]) -> None:
        """Add a reader's sample and the output of ``RigRetarget``."""
        self._stream.set_time("frame", sequence=self._frames)
        if sample.get("time_s") is not None:
            self._first.setdefault("time_s", float(sample["time_s"]))
            self._stream.set_time("time", duration=float(sample["time_s"]) - self._first["time_s"])
        if sample.get("ego2world") is not None:
            ego2world = np.asarray(sample["ego2world"], np.float64)
            self._add_pose("/ego", np.linalg.inv(self._first.setdefault("ego2world", ego2world)) @ ego2world)
        source: Rig = sample["rig"]
        boxes = np.zeros((0, 7)) if sample.get("boxes_3d") is None else sample["boxes_3d"].double().numpy()
        turns = np.zeros((len(boxes), 4))
        turns[:, 2], turns[:, 3] = np.sin(boxes[:, 6] / 2), np.cos(boxes[:, 6] / 2)
        shape = {"centers": boxes[:, :3], "sizes": boxes[:, 3:6], "quaternions": turns, "colors": BOX}
        self._log("/ego/boxes", self._rr.Boxes3D(**shape, labels=sample.get("box_names"), show_labels=False))
        clouds = {"source": sample.get("points"), "target": out.get("points") if self._target.lidars else None}
        for side, points in clouds.items():
            positions = np.zeros((0, 3)) if points is None else points[:, :3].numpy()
            colours = coloured((positions[:, 2] - source.ground_z_m - _LOW_M) / (_HIGH_M - _LOW_M))
            self._log(f"/ego/{side}_points", self._rr.Points3D(positions, colors=colours, radii=_THIN))
        for camera, image in zip(source, as_arrays(sample["images"]), strict=True):
            path = self._path("source", camera)
            self._add_camera(path, camera, image, boxes, RIG_COLOURS[0])
            if camera.mask is not None:
                self._add_classes(path, np.where(camera.mask, _SEEN, _MASKED))
        for camera, view in zip(self._target.in_frame_of(source), views_of(out), strict=True):
            path = self._path("target", camera)
            self._add_camera(path, camera, view.image, boxes, RIG_COLOURS[1])
            hole = _BLACK if view.generated is None else np.where(view.generated, _FILLED, _BLACK)
            self._add_classes(path, np.where(view.coverage, _SEEN, hole))
            if view.confidence is not None:
                percent = np.rint(100 * view.confidence).astype(np.uint8)
                picture = self._rr.DepthImage(percent, meter=100.0, depth_range=(0.0, 100.0), colormap="viridis")
                self._log(f"{path}/confidence", picture)
        self._frames += 1

    def _add_pose(self, path: str, pose: FloatArray) -> None:
        self._log(path, self._rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

    def _add_camera(self, path: str, camera: Camera, image: Image, boxes: FloatArray, colour: str) -> None:
        """Add a camera's pose, image and boxes; Rerun's cameras have no lenses: images with one are not in 3D."""
        self._add_pose(path, camera.cam2ego)
        K = camera.K.copy()
        K[:2, 2] += _PIXEL_CENTER
        frustum = {"resolution": camera.size[::-1], "image_plane_distance": _FRUSTUM_M}
        pinhole = self._rr.Pinhole(image_from_camera=K, color=tuple(bytes.fromhex(colour[1:])), **frustum)
        self._log(path if camera.is_rectilinear else f"{path}/frustum", pinhole)
        (pixels,) = as_tensors([image])
        self._log(f"{path}/image", self._rr.EncodedImage(contents=encoded_image(pixels), media_type="image/jpeg"))
        lines = [(segments, colour) for box in boxes for segments, colour in box_lines(camera, box)]
        strips = np.concatenate([np.zeros((0, 2, 2)), *(segments for segments, _ in lines)]) + _PIXEL_CENTER
        colours = [colour for segments, colour in lines for _ in segments]
        self._log(f"{path}/boxes", self._rr.LineStrips2D(strips, colors=colours, radii=_THIN))

    def _add_classes(self, path: str, classes: Any) -> None:
        self._log(f"{path}/coverage", self._rr.SegmentationImage(classes.astype(np.uint8), opacity=0.5))
