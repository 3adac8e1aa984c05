"""``python -m integrations.benchmarks.label_holes``: do holes draw the labels? On streets with known holes.

For every moved rig and surface: rings around labelled objects against the same rings slid sideways (the protocol of
``label_leak``), holes against the true ones, fills against the true views, and a probe: a small classifier that learns
on retargeted views to tell rings around objects from slid ones. It is an artefact that it learned if it finds more on
other retargeted views than on true ones.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import cv2
import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug import RigRetarget
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import add_output, count, seed, size, writable_folder
from arbiview_aug.cli.bench.timing import benchmark, machine_line, show
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from integrations.benchmarks.hidden import check_tiled, true_views
from integrations.benchmarks.study import run_study, study_parser

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating]

TARGETS = {"up70": lambda size: demo_source_rig(size).shifted(z_m=0.7), "van": demo_target_rig}
MARGIN_PX, LEAST_PX, SHARE, SLIDES = 6, 8, 0.05, 20
"""The protocol's half width of a ring, the least side of an object, the share of holes that counts as leak, and
how often a ring is slid."""

PATCH_PX, PROBE_SLIDES, EPOCHS = 32, 4, 6


class Street(NamedTuple):
    """A sample, and for a target: its rig, true images (M, h, w, 3), true holes, rows of objects, rectangles."""

    sample: dict[str, Any]
    rig: Rig
    images: npt.NDArray[np.uint8]
    holes: Bools
    objects: Bools
    rectangles: list[Floats]


# --- the truth --------------------------------------------------------------------------------------------------------
def make_street(drive: SyntheticDrive, index: int, target: Rig) -> Street:
    """Street ``index`` with its truth for a target."""
    sample, views = drive[index], true_views(drive, index, target)
    rectangles = []
    for found in project_boxes_3d(sample["boxes_3d"], target):
        wide, high = (found.boxes[:, 2:] - found.boxes[:, :2]).T
        rectangles.append(found.boxes[(np.minimum(wide, high) >= LEAST_PX) & (found.visibility > 0)])
    return Street(sample, target, views.images, ~views.seen, views.instances >= 0, rectangles)


# --- rings ------------------------------------------------------------------------------------------------------------
def ring(size: tuple[int, int], box: Floats, margin: int = MARGIN_PX) -> Bools:
    """(h, w) pixels up to ``margin`` on both sides of a rectangle's outline."""
    (x0, y0, x1, y1), inside = box, np.zeros(size, bool)
    inside[max(0, int(y0 - margin)) : int(y1 + margin) + 1, max(0, int(x0 - margin)) : int(x1 + margin) + 1] = True
    inner = [max(0, int(value)) for value in (y0 + margin, y1 - margin, x0 + margin, x1 - margin)]
    inside[inner[0] : inner[1], inner[2] : inner[3]] = False
    return inside


def slid(box: Floats, width: int, rng: np.random.Generator) -> Floats:
    """A rectangle at another place of the same rows."""
    x = rng.uniform(0, max(1.0, width - (box[2] - box[0])))
    return np.array([x, box[1], x + box[2] - box[0], box[3]])


def ring_holes(holes: Bools, rectangles: Sequence[Floats], seed: int = 0) -> tuple[list[float], list[float]]:
    """Shares of holes (M, h, w) in the rings of objects, and in those slid sideways."""
    rng, own, control = np.random.default_rng(seed), [], []
    for hole, boxes in zip(holes, rectangles, strict=True):
        for box in boxes:
            own.append(float(hole[ring(hole.shape, box)].mean()))
            places = [slid(box, hole.shape[1], rng) for _ in range(SLIDES)]
            control += [float(hole[ring(hole.shape, place)].mean()) for place in places]
    return own, control


# --- the probe --------------------------------------------------------------------------------------------------------
def patches(
    images: npt.NDArray[np.uint8], rectangles: Sequence[Floats], seed: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rings as pictures (n, 4, PATCH_PX, PATCH_PX), grey inside, with their mask; and whether an object is there."""
    rng, found, is_object = np.random.default_rng(seed), [], []
    for image, boxes in zip(images, rectangles, strict=True):
        for box in boxes:
            for k in range(1 + PROBE_SLIDES):
                place = box if k == 0 else slid(box, image.shape[1], rng)
                mask = ring(image.shape[:2], place)
                rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
                if not len(rows):
                    continue
                part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
                colour = np.where(mask[part][..., None], image[part], 128).astype(np.float32) / 255
                layers = np.dstack([colour, mask[part].astype(np.float32)])
                found.append(cv2.resize(layers, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_AREA).transpose(2, 0, 1))
                is_object.append(k == 0)
    return torch.from_numpy(np.stack(found)), torch.tensor(is_object, dtype=torch.float32)


def train_probe(x: torch.Tensor, y: torch.Tensor, seed: int) -> torch.nn.Module:
    """A small convolutional classifier of patches."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        widths = (4, 16, 32, 64)
        layers: list[torch.nn.Module] = []
        for one, two in itertools.pairwise(widths):
            layers += [torch.nn.Conv2d(one, two, 3, padding=1), torch.nn.ReLU(), torch.nn.MaxPool2d(2)]
        net = torch.nn.Sequential(*layers, torch.nn.Flatten(), torch.nn.Dropout(0.3), torch.nn.LazyLinear(1))
        net(x[:1])
        optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-2)
        weight = (1 - y.mean()) / y.mean()  # objects are the fewer
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(x)).split(64):
                mirrored = x[rows].flip(-1) if torch.rand(()) < 0.5 else x[rows]
                loss = torch.nn.functional.binary_cross_entropy_with_logits(
                    net(mirrored)[:, 0], y[rows], pos_weight=weight
                )
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
    return net.eval()


def area_under_curve(score: torch.Tensor, y: torch.Tensor) -> float:
    """Probability that an object's ring scores above another (ties count half)."""
    one, other = score[y > 0.5], score[y < 0.5]
    return float(((one[:, None] > other).float() + 0.5 * (one[:, None] == other).float()).mean())


def probe(streets: Sequence[Street], views: Sequence[npt.NDArray[np.uint8]], seed: int) -> tuple[float, float]:
    """Areas under the curve on retargeted and on true views, mean over two folds of streets."""
    areas = []
    for fold in (0, 1):
        rows = [k for k in range(len(streets)) if k % 2 == fold]
        others = [k for k in range(len(streets)) if k % 2 != fold]
        rectangles = [box for k in others for box in streets[k].rectangles]
        net = train_probe(*patches(np.concatenate([views[k] for k in others]), rectangles, seed), seed)
        rectangles = [box for k in rows for box in streets[k].rectangles]
        for images in (views, [street.images for street in streets]):
            x, y = patches(np.concatenate([images[k] for k in rows]), rectangles, seed + 1)
            with torch.no_grad():
                areas.append(area_under_curve(torch.cat([net(part)[:, 0] for part in x.split(512)]), y))
    return float(np.mean(areas[0::2])), float(np.mean(areas[1::2]))


# --- figures ----------------------------------------------------------------------------------------------------------
def figures(streets: Sequence[Street], surface: str, seed: int) -> dict[str, float]:
    """All columns of one surface over one target's streets."""
    retarget = RigRetarget(streets[0].rig, geometry=surface, neighbours=None)
    views, rings, true_rings, controls, true_controls, errors = [], [], [], [], [], []
    found = np.zeros(5)  # true positives, false positives, false negatives, hidden pixels of objects, those covered
    for street in streets:
        out = retarget(street.sample)
        image, holes = np.asarray(out["images"]).transpose(0, 2, 3, 1), ~np.asarray(out["coverage"])
        views.append(image)
        for truth, own, control in ((holes, rings, controls), (street.holes, true_rings, true_controls)):
            at_objects, elsewhere = ring_holes(truth, street.rectangles, seed)
            own += at_objects
            control += elsewhere
        hidden = street.holes & street.objects
        found += [
            np.count_nonzero(mask)
            for mask in (holes & street.holes, holes & ~street.holes, ~holes & street.holes, hidden, hidden & ~holes)
        ]
        square = np.square(image.astype(np.float32) - street.images).mean(-1)
        errors.append([psnr_db(float(part.mean())) for part in (square, square[street.holes], square[~holes])])
    hit, wrong, missed, hidden_px, hidden_covered = found
    retargeted, true = probe(streets, views, seed)
    return {
        "leak": float(np.mean(np.array(rings) > SHARE)),
        "control": float(np.mean(np.array(controls) > SHARE)),
        "true_leak": float(np.mean(np.array(true_rings) > SHARE)),
        "true_control": float(np.mean(np.array(true_controls) > SHARE)),
        "ring_holes": float(np.mean(rings)),
        "true_ring_holes": float(np.mean(true_rings)),
        "precision": hit / (hit + wrong),
        "recall": hit / (hit + missed),
        "hidden_covered": hidden_covered / max(hidden_px, 1),
        **dict(zip(("whole_db", "true_holes_db", "covered_db"), np.mean(errors, axis=0).tolist(), strict=True)),
        "probe_retargeted": retargeted,
        "probe_true": true,
    }


# --- the command ------------------------------------------------------------------------------------------------------
def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "Whether holes draw the labels, on synthetic streets whose true holes are known."
    parser = study_parser("label_holes", text, "--streets 20")
    parser.add_argument("--size", type=size, default=(256, 704), metavar="HxW", help="of every view, multiples of 16")
    parser.add_argument("--streets", type=count, default=20, metavar="N", help="2 or more, for two folds")
    parser.add_argument("--seed", type=seed, default=50, metavar="N", help="of the streets and the probe")
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    surfaces = get_args(GeometryName)
    parser.add_argument("--surfaces", nargs="+", choices=surfaces, default=["auto", "boxes"], help="geometry")
    add_output(parser)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    if arguments.streets < 2:
        raise DataError("--streets: expected 2 or more, got 1: the probe learns on one half and is tried on the other")
    check_tiled(arguments.size)
    folder = writable_folder(Path(arguments.output), arguments.output)
    report = measure(arguments)
    show(table(report), report, folder / "label_holes.json")


@benchmark
def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rows."""
    drive = SyntheticDrive(demo_source_rig(arguments.size), num_frames=arguments.streets, seed=arguments.seed)
    rows = {}
    for name in arguments.targets:
        rig = TARGETS[name](arguments.size)
        streets = [make_street(drive, k, rig) for k in tqdm(range(len(drive)), desc=name, leave=False)]
        for surface in arguments.surfaces:
            rows[f"{name} {surface}"] = figures(streets, surface, arguments.seed)
    return {"streets": arguments.streets, "seed": arguments.seed, "size": list(arguments.size), "rows": rows}


_COLUMNS = (
    ("leak, control %", "{leak:.0%}, {control:.0%}"),
    ("of true holes", "{true_leak:.0%}, {true_control:.0%}"),
    ("holes in rings", "{ring_holes:.1%}"),
    ("true", "{true_ring_holes:.1%}"),
    ("precision, recall", "{precision:.0%}, {recall:.0%}"),
    ("hidden, called covered", "{hidden_covered:.0%}"),
    ("whole dB", "{whole_db:.2f}"),
    ("true holes dB", "{true_holes_db:.2f}"),
    ("covered dB", "{covered_db:.2f}"),
    ("probe", "{probe_retargeted:.3f}"),
    ("probe on true views", "{probe_true:.3f}"),
)


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""
    rows = [{"name": name, **row} for name, row in report["rows"].items()]
    return f"{machine_line(report)}\n\n{metric_table(rows, _COLUMNS)}"


if __name__ == "__main__":
    sys.exit(main())
