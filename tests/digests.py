"""Digests of all public outputs, bit for bit: ``python -m tests.digests [--against FILE]``.

Run it before and after a change that must not change what users get. Public names alone are used, so that the same
file runs on both sides. Without the folder of real frames (``ARBIVIEW_DATA``) only the synthetic street is digested.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug import RandomRig, RigRetarget, SampleKeys, load_rig, project_boxes_3d
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, Neighbours, NuScenesDataset
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.inpaint import Telea

ALL = ("source_camera", "source_frame", "confidence")
SETTINGS: dict[str, dict[str, Any]] = {
    "fast": {},
    "black": {"holes": "black", "keys": SampleKeys(extra=ALL)},
    "mean": {"holes": "mean"},
    "draft": {"quality": "draft"},
    "accurate": {"quality": "accurate", "geometry": "street", "keys": SampleKeys(extra=ALL)},
    "paper": {"quality": "paper", "keys": SampleKeys(extra=("source_camera",))},
    "infinity": {"geometry": "infinity"},
    "ground": {"geometry": "ground"},
    "street": {"geometry": "street", "keys": SampleKeys(extra=ALL)},
    "boxes": {"geometry": "boxes", "keys": SampleKeys(extra=ALL)},
    "lidar": {"geometry": "lidar", "keys": SampleKeys(extra=ALL)},
    "motion": {"geometry": "motion", "keys": SampleKeys(extra=ALL)},
    "harmonised": {"match_exposure": True},
    "torch": {"backend": "torch", "keys": SampleKeys(extra=ALL)},
    "inpaint": {"holes": "telea"},
    "inpaint doubtful": {"holes": Telea(min_confidence=0.4)},
    "all neighbours": {"neighbours": "all", "keys": SampleKeys(extra=ALL)},
    "no neighbours": {"neighbours": None, "keys": SampleKeys(extra=ALL)},
    "target frame": {"keys": SampleKeys(frame="target")},
    "cropped": {"size": (64, 96)},
    "padded": {"size": (64, 96), "fit": "pad"},
    "stretched": {"size": (64, 96), "fit": "stretch"},
}


def digest(value: Any) -> str:
    """Hexadecimal digits of a nested value: tensors and arrays by bytes, everything else by its words."""
    found = hashlib.sha256()
    for part in _parts(value):
        found.update(part)
    return found.hexdigest()[:16]


def _parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().contiguous().numpy()
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Mapping):
        for key in sorted(value):
            if key != "neighbours":  # frames that are decoded late
                yield str(key).encode()
                yield from _parts(value[key])
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _parts(entry)
    elif hasattr(value, "to_dict"):
        yield json.dumps(value.to_dict(), sort_keys=True).encode()
    else:
        yield repr(value).encode()


def street() -> dict[str, Any]:
    """A frame of a synthetic drive with LiDAR, boxes, neighbours and label maps."""
    rig = load_rig("nuscenes").undistorted().resized((90, 160))
    sample = SyntheticDrive(rig, num_frames=2, neighbours=Neighbours(count=1, step_m=1.2))[1]
    sample["semantics"] = (sample["images"].sum(1) % 7).to(torch.uint8)
    return sample


def samples(data: Path | None) -> dict[str, dict[str, Any]]:
    """Frames to retarget, by name."""
    found = {"street": street()}
    if data is not None:
        found["nuscenes"] = NuScenesDataset(data / "nuscenes-one", reduce=4)[0]
        found["ddad"] = FrameFolder(data / "ddad-one", reduce=4)[0]
        found["fisheye"] = FrameFolder(data / "surround-fisheye", reduce=4)[0]
    return found


def outputs(sample: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Outputs of every setting, for turned, lifted, lens and drawn targets."""
    rig = sample["rig"]
    lifted = rig.turned(yaw_deg=11.0).with_cameras([c.shifted(z_m=0.5) for c in rig.turned(yaw_deg=11.0)])
    pinhole = all(camera.lens == "pinhole" for camera in rig)
    labels = ("semantics",) if "semantics" in sample else ()
    for name, settings in SETTINGS.items():
        if name in ("motion", "all neighbours") and not sample.get("neighbours"):
            continue
        if (name == "paper" and not pinhole) or (name == "boxes" and "boxes_3d" not in sample):
            continue
        if name == "lidar" and "points" not in sample:
            continue
        keys = replace(settings.get("keys", SampleKeys()), labels=labels)
        out = RigRetarget(lifted, **settings | {"keys": keys})(sample)
        yield name, {key: value for key, value in out.items() if key != "sources"}
    yield "words", str(RigRetarget(lifted).explain(sample))
    turned = rig.turned(yaw_deg=11.0, pitch_deg=-5.0)  # at the centres of A's cameras
    yield "turned", RigRetarget(turned, keys=SampleKeys(labels=labels))(sample)
    yield "waymo", RigRetarget(load_rig("waymo").resized((64, 96)), keys=SampleKeys(labels=labels))(sample)
    lenses = load_rig("fisheye_surround").resized((64, 96))
    yield "fisheye", RigRetarget(lenses, keys=SampleKeys(extra=ALL, labels=labels))(sample)
    torch.manual_seed(0)
    drawn = RandomRig(rig, yaw_deg=10, height_m=(0, 0.5), focal_scale=0.1)
    random = RigRetarget(drawn, size=(64, 96), p=0.5, keys=SampleKeys(labels=labels))
    yield "random", [random(sample) for _ in range(3)]
    if isinstance(sample["images"], torch.Tensor):
        floats = {**sample, "images": sample["images"].float() / 255}
        yield "float", RigRetarget(lifted, keys=SampleKeys(labels=labels))(floats)
    if "boxes_3d" in sample:
        boxes = project_boxes_3d(sample["boxes_3d"], RigRetarget(lifted, keys=SampleKeys(labels=labels))(sample))
        yield "boxes 2D", [vars(box) if hasattr(box, "__dict__") else box for box in boxes]


def files_of(folder: Path) -> dict[str, str]:
    """Digests of a conversion's files; its own records name versions and times, and stay out."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "conversion" not in path.relative_to(folder).parts:
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def commands(data: Path | None) -> Iterator[tuple[str, Any]]:
    """Files that commands write: conversions by their bytes, rigs by their words."""
    with tempfile.TemporaryDirectory() as scratch:
        if data is not None:
            for kind, folder in (("nuscenes", "nuscenes-one"), ("frames", "ddad-one")):
                for holes in ("continue", "black"):
                    output = Path(scratch, f"{kind}-{holes}")
                    arguments = ["convert", "--data", f"{kind}:{data / folder}", "--target", "argoverse2"]
                    arguments += ["--size", "64x96", "--downscale", "4", "--workers", "1"]
                    yield (
                        f"convert {kind} {holes}",
                        _quiet([*arguments, "--output", str(output), "--holes", holes]) or files_of(output),
                    )
    yield "inspect", _said(["inspect", "nuscenes", "waymo"])


def _quiet(arguments: list[str]) -> int:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return main(arguments)


def _said(arguments: list[str]) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as said, tempfile.TemporaryDirectory() as folder:
        before = Path.cwd()
        os.chdir(folder)  # pictures go here
        try:
            main(arguments)
        finally:
            os.chdir(before)
    return said.getvalue()


def all_digests(data: Path | None) -> dict[str, str]:
    """Every digest by its name."""
    found: dict[str, str] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for frame, sample in samples(data).items():
            found[f"{frame}: sample"] = digest(sample)
            for name, value in outputs(sample):
                found[f"{frame}: {name}"] = digest(value)
        for name, value in commands(data):
            found[name] = digest(value)
    return found


def report(argv: list[str] | None = None) -> int:
    """Print the digests as JSON; with ``--against``, the names of those that differ, and exit status 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.digests", description=__doc__)
    parser.add_argument("--against", type=Path, metavar="FILE", help="digests that an earlier run printed")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    data = os.environ.get("ARBIVIEW_DATA")
    found = all_digests(Path(data) if data else None)
    if arguments.against is None:
        print(json.dumps(found, indent=1))
        return 0
    before = json.loads(arguments.against.read_text())
    changed = [name for name in sorted(before | found) if before.get(name) != found.get(name)]
    print("\n".join(f"differs: {name}" for name in changed) or f"{len(found)} digests, all equal")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(report())
