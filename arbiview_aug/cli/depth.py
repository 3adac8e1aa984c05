"""``python -m arbiview_aug depth --data FOLDER``: depth from motion of every frame, into files beside the data set."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import inside
from arbiview_aug.cli.arguments import add_data, command_parser, count, gathered_warnings, writable_folder
from arbiview_aug.cli.parallel import results
from arbiview_aug.datasets.motion_depth import FOLDER, WANTED, DepthFolder
from arbiview_aug.datasets.registry import open_data, split_kind
from arbiview_aug.errors import ArbiviewError, WarnOnce, described
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.neighbours import Neighbour, neighbours_of_frames, warn_lost
from arbiview_aug.temporal.motion_depth import compile_matching, motion_depth


class Done(NamedTuple):
    """Result of a frame."""

    token: str
    density: float  # share of pixels with known distance; 0 if depth was declined
    message: str  # how depth was found, or why not
    failed: bool = False  # whether the frame could not be read
    existed: bool = False  # whether its file existed before


class _Frames(Dataset[Done]):
    """Frames whose depth is computed and written on access, in a DataLoader's workers."""

    def __init__(self, data: Any, tokens: Sequence[str], depths: DepthFolder) -> None:
        self.data, self.tokens, self.depths = data, tokens, depths

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> Done:
        token = self.tokens[index]
        try:
            return self._done(token, self.data[index])
        except Exception as error:  # the other frames go on
            return Done(token, 0.0, described(error), failed=True)

    def _done(self, token: str, sample: dict[str, Any]) -> Done:
        rig = sample["rig"]
        (frame,) = read_frames(sample, None)
        warn = WarnOnce()
        (neighbours,) = neighbours_of_frames(sample, [frame], (), warn)
        used = [neighbour.name for neighbour in neighbours]
        known = self.depths.find(token, rig, used)
        if known is not None:
            return Done(token, known.density, "", existed=True)
        boxes = None if sample.get("boxes_3d") is None else sample["boxes_3d"].numpy().astype(float)

        def load(neighbour: Neighbour) -> Sequence[torch.Tensor] | None:
            try:
                return neighbour.images(frame.images)
            except (ArbiviewError, OSError) as error:
                warn_lost(warn, neighbour.name, error)
                used.remove(neighbour.name)  # the frame is done again once the neighbour can be read
                return None

        found = motion_depth(frame.rig, frame.images, neighbours, boxes, load)
        self.depths.write(token, rig, found, used)
        return Done(token, found.density, str(found))


def main(argv: Sequence[str] | None = None) -> int:
    """Compute and write the depth of every frame that has none yet; return 1 if a frame failed, else 0."""
    parser = command_parser(
        "depth",
        "Compute depth from motion of every frame of a drive, for surface='motion'. Frames whose depth is there, from "
        "the same neighbours, are left as they are: run it again to go on.",
        "--data nuscenes:ROOT --workers 4",
    )
    add_data(parser)
    parser.add_argument("--output", metavar="FOLDER", help=f"where to write (default: {FOLDER} in the data's folder)")
    parser.add_argument("--workers", type=count, default=1, metavar="N", help="processes")
    arguments = parser.parse_args(argv)
    data: Any = open_data(arguments.data, neighbours=WANTED)
    _, root = split_kind(arguments.data)
    folder = Path(arguments.output) if arguments.output else inside(root, FOLDER, "depth from motion")
    depths = DepthFolder(writable_folder(folder, str(folder)))
    frames = _Frames(data, data.tokens, depths)
    compile_matching()
    warned: list[str] = []
    with gathered_warnings(warned):
        done = list(results(frames, arguments.workers, "depth from motion"))
    for line in warned:
        print(line, file=sys.stderr)
    return _summary(done, depths)


def _summary(done: Sequence[Done], depths: DepthFolder) -> int:
    failed = [one for one in done if one.failed]
    existed = [one for one in done if one.existed]
    known = [one.density for one in done if one.density > 0]
    share = f", {sum(known) / len(known):.0%} of their pixels on average" if known else ""
    print(f"{depths.root}: {len(known)} of {len(done)} frames have depth{share}; {len(existed)} were there before")
    for one in done:
        if one.failed:
            print(f"  {one.token}: failed: {one.message}", file=sys.stderr)
        elif one.density == 0 and not one.existed:
            print(f"  {one.token}: {one.message}")
    return 1 if failed else 0
