"""``python -m arbiview_aug inspect RIG [RIG ...]``: rigs as tables, their differences, and a picture."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from arbiview_aug.cameras.rig import Rig, load_rig, shipped_rigs
from arbiview_aug.cli.arguments import command_parser, data
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE
from arbiview_aug.datasets.registry import open_data, split_kind
from arbiview_aug.errors import ArbiviewError


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rigs and, for two or more, what separates the others from the first; write the picture."""
    parser = command_parser("inspect", "Show rigs: tables, differences, a picture.", "nuscenes waymo")
    parser.add_argument(
        "rigs",
        nargs="+",
        metavar="RIG",
        help=f"a shipped rig ({', '.join(shipped_rigs())}), a rig file (YAML or JSON), or data as other commands' "
        "--data takes it: the rig of its first frame",
    )
    parser.add_argument("--output", default="inspect.png", metavar="FILE", help="the picture")
    arguments = parser.parse_args(argv)
    # Drawing is only needed here: --help and wrong rigs answer without it.
    from arbiview_aug.evaluate.report.pictures import save_picture
    from arbiview_aug.evaluate.report.rig_picture import draw_rigs

    try:
        rigs = [_load(name) for name in arguments.rigs]
        print("\n\n".join(map(repr, rigs)))
        for other in rigs[1:]:
            print(f"\n{differences(rigs[0], other)}")
        print(f"\npicture: {save_picture(arguments.output, draw_rigs(rigs))}")
    except ArbiviewError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    return 0


def differences(source: Rig, target: Rig) -> str:
    """A table: for each target camera the source camera that looks most nearly the same way, and what separates them.

    Heights are over each rig's own road, as retargeting aligns them (see ``Rig.in_frame_of``).
    """
    mounted = target.in_frame_of(source)
    axes = source.cam2ego[:, :3, 2]
    width = max(len(n) for n in target.names)
    other_width = max(len("nearest"), *(len(n) for n in source.names))
    lines = [
        f"From {source.name or 'the first rig'} to {target.name or 'the other rig'}:",
        f"  {'camera':<{width}}  {'nearest':<{other_width}}  {'turned':>9}  {'moved x':>7} {'y':>6} {'z':>6}"
        f"  {'field of view':>13}  {'pixels per deg':>14}",
    ]
    for camera in mounted:
        cosine = axes @ camera.cam2ego[:3, 2]
        nearest = source[int(np.argmax(cosine))]
        turned = float(np.degrees(np.arccos(np.clip(cosine.max(), -1, 1))))
        x, y, z = camera.center_m - nearest.center_m
        lines.append(
            f"  {camera.name:<{width}}  {nearest.name:<{other_width}}  {turned:5.1f} deg  {x:+7.2f} {y:+6.2f} {z:+6.2f}"
            f"  {nearest.fov_deg[0]:5.1f} > {camera.fov_deg[0]:5.1f}"
            f"  {_pixels_per_deg(nearest.K):5.1f} > {_pixels_per_deg(camera.K):6.1f}"
        )
    return "\n".join(lines)


def _pixels_per_deg(K: np.ndarray) -> float:
    """On the optical axis."""
    return float(K[0, 0] * np.pi / 180)


def _load(name: str) -> Rig:
    kind, root = split_kind(name)
    if kind is None and (root / CALIBRATION_FILE).is_file():  # its images need not be there
        return load_rig(root / CALIBRATION_FILE)
    if kind is None and not root.is_dir():
        return load_rig(name)
    recording = open_data(data(name))
    recording.load_points = False
    rig: Rig = recording[0]["rig"]
    return rig
