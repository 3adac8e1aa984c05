"""``python -m arbiview_aug depth --data FOLDER``: depth of every frame, in files next to the data set.

From the motion of the vehicle, or with ``--model`` by a network.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import mean, median
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import inside, remove_parts
from arbiview_aug.choices import Reference
from arbiview_aug.cli.arguments import gathered_warnings, reading, writable_folder
from arbiview_aug.cli.parallel import results
from arbiview_aug.datasets.depth_folder import FOLDER, LEARNED_FOLDER, WANTED, DepthFolder
from arbiview_aug.datasets.registry import open_data, split_kind
from arbiview_aug.environment import compilation_announced
from arbiview_aug.errors import OutputError, WarnOnce, described
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import MOTION_KEY, read_frames, read_scene
from arbiview_aug.sample.neighbours import neighbour_images
from arbiview_aug.scene.depth_map import points_of
from arbiview_aug.temporal.learned_depth import CameraFit, TransformersDepth, learned_depth
from arbiview_aug.temporal.motion_depth import motion_depth, warm_up


class Done(NamedTuple):
    """Result of a frame."""

    token: str
    state: Literal["made", "kept", "failed", "stopped"]  # kept: made by an earlier run; stopped: no more can be made
    message: str = ""  # how depth was found, or why not
    density: float = 0.0  # share of pixels with known distance; 0 if depth was declined
    fits: Sequence[CameraFit] = ()  # of a network's depth


class _Loaded(NamedTuple):
    """A frame for a network, and the origin to record in its file."""

    token: str
    frame: Frame  # its points and depth are the references that were asked for
    origin: Sequence[str]


class _Frames(Dataset[Any]):
    """Dataset that runs ``work`` on each frame on access, in a DataLoader's workers."""

    def __init__(self, data: Any, work: Callable[[str, dict[str, Any]], Done | _Loaded]) -> None:
        self.data, self.work = data, work

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> Done | _Loaded:
        token = self.data.tokens[index]
        try:
            return self.work(token, self.data[index])
        except OutputError as error:  # a full disk
            return Done(token, "stopped", str(error))
        except Exception as error:  # the other frames are not affected
            return Done(token, "failed", described(error))


def _from_motion(depths: DepthFolder, token: str, sample: dict[str, Any]) -> Done:
    """Compute and write a frame's depth from motion, unless it is there."""
    warn = WarnOnce()
    (frame,) = read_frames(sample, None, further=("neighbours",), warn=warn)
    used = [neighbour.name for neighbour in frame.neighbours or ()]
    known = depths.find(token, sample["rig"], used)
    if known is not None:
        return Done(token, "kept", density=known.density)
    boxes = None if sample.get("boxes_3d") is None else sample["boxes_3d"].numpy().astype(float)

    def load(neighbour: Neighbour) -> Sequence[torch.Tensor] | None:
        images = neighbour_images(neighbour, frame.images, warn)
        if images is None:
            used.remove(neighbour.name)  # the frame is done again once the neighbour can be read
        return images

    depth = motion_depth(frame.rig, frame.images, frame.neighbours or (), boxes, load)
    depths.write(token, sample["rig"], depth, used)
    return Done(token, "made", str(depth), depth.density)


def _for_network(
    depths: DepthFolder,
    motion: DepthFolder,
    model: Sequence[str],
    wanted: Sequence[Reference],
    token: str,
    sample: dict[str, Any],
) -> _Loaded | Done:
    """Load a network's inputs of a frame, unless its depth is there; ``model`` is its record, ``motion`` a folder."""
    (frame,) = read_frames(sample, None, "auto")
    scene = read_scene(frame, "auto")
    measured = [] if scene.points is None else [scene.points[:, :3]]
    if isinstance(maps := scene.further.get("depth_m"), tuple):
        measured.append(points_of(maps)[0])
    points = np.concatenate(measured).astype(float) if measured and "LiDAR" in wanted else None
    is_there = "motion" in wanted and motion.path(token).is_file()
    from_motion = motion.read(token, sample["rig"]) if is_there else None
    used = [name for name, value in (("LiDAR", points), ("motion", from_motion)) if value is not None]
    origin = [*model, *used, *(["road"] if "road" in wanted else [])]
    there = depths.find(token, sample["rig"], origin, "learned")
    if there is not None:
        return Done(token, "kept", density=there.density)
    depth = {} if from_motion is None else {MOTION_KEY: from_motion.depth_m}
    return _Loaded(token, Frame(frame.images, frame.rig, points, scene.boxes, depth), origin)


def run(arguments: argparse.Namespace) -> int:
    """Compute and write the depth of every frame that has none yet; return 1 if one failed or none has depth."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    _, root = split_kind(arguments.data)
    warned: list[str] = []
    with gathered_warnings(warned):
        data: Any = open_data(arguments.data, neighbours=None if arguments.model else WANTED, **reading(arguments))
        folder = Path(arguments.output or inside(root, LEARNED_FOLDER if arguments.model else FOLDER, "depth"))
        model = TransformersDepth(arguments.model, device) if arguments.model else None  # before the folder is made
        depths = DepthFolder(writable_folder(folder, str(folder)))
        remove_parts(folder, lambda owner: False)
        if model is not None:
            steps = _learned(model, data, depths, DepthFolder(inside(root, FOLDER, "depth")), arguments)
        else:
            with compilation_announced():
                warm_up()  # here, once, and not in every worker
            steps = results(_Frames(data, partial(_from_motion, depths)), arguments.workers, "depth from motion")
        done: list[Done] = []
        for frame in steps:
            done.append(frame)
            if frame.state == "stopped":
                break
    for line in warned:
        print(line, file=sys.stderr)
    known, kept = [frame.density for frame in done if frame.density], sum(frame.state == "kept" for frame in done)
    share = f", {mean(known):.0%} of their pixels on average" if known else ""
    print(f"{depths.root}: {len(known)} of {len(done)} frames have depth{share}; {kept} were there before")
    by_camera: dict[str, list[CameraFit]] = defaultdict(list)
    for fit in chain.from_iterable(frame.fits for frame in done):
        by_camera[fit.camera].append(fit)
    for camera, fits in by_camera.items():
        used = [fit for fit in fits if not fit.declined]
        residuals = [fit.residual for fit in used if fit.residual is not None]
        to = ", ".join(sorted({fit.reference for fit in used if fit.reference is not None}))
        fitted = f" to {to}, residual {median(residuals):.1%} (worst {max(residuals):.1%})" if residuals else ""
        print(f"  {camera}: {len(used)} of {len(fits)} frames fitted{fitted}")
        for reason, count in Counter(fit.declined for fit in fits if fit.declined).most_common(3):
            print(f"    declined in {count}: {reason}")
    failed = [frame for frame in done if frame.state in ("failed", "stopped")]
    for frame in done:
        if frame in failed:
            print(f"  {frame.token}: failed: {frame.message}", file=sys.stderr)
        elif frame.state == "made" and not frame.density:
            print(f"  {frame.token}: {frame.message}")
    return int(bool(failed) or not known)


def _learned(
    model: TransformersDepth, data: Any, depths: DepthFolder, motion: DepthFolder, arguments: argparse.Namespace
) -> Iterator[Done]:
    """Predict, fit and write the frames that have no depth of this model yet."""
    facts = [f"model {model.name}", f"revision {model.revision}", f"licence {model.licence}"]
    wanted = [name for name in get_args(Reference) if name in arguments.reference]
    waiting: list[_Loaded] = []
    dataset = _Frames(data, partial(_for_network, depths, motion, facts, wanted))
    frames = results(dataset, arguments.workers, "learned depth")
    for frame in chain(frames, [None]):
        if isinstance(frame, Done):
            yield frame
        elif frame is not None:
            waiting.append(frame)
        if frame is None or sum(len(loaded.frame.rig) for loaded in waiting) >= arguments.batch:
            fitted = learned_depth(model, [loaded.frame for loaded in waiting], arguments.batch, wanted)
            for loaded, (depth, fits) in zip(waiting, fitted, strict=True):
                depths.write(loaded.token, loaded.frame.rig, depth, loaded.origin)
                yield Done(loaded.token, "made", "; ".join(map(str, fits)), depth.density, fits)
            waiting.clear()
