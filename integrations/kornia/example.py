"""``python -m integrations.kornia.example``: retarget, crop, then change colours, by torchvision and by kornia."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import kornia.augmentation as K
import numpy as np
import torch
from torchvision import tv_tensors
from torchvision.transforms import v2

from arbiview_aug import CropRig, ResizeRig, RigRetarget, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.kornia import OnImages


def torchvision_pipeline() -> v2.Compose:
    """Ours inside ``v2.Compose``: photometric transforms after it see a ``tv_tensors.Image``."""
    return v2.Compose(
        [
            RigRetarget(load_rig("waymo").undistorted(), size=(160, 352), geometry="boxes"),
            CropRig(32, 0, (128, 352)),  # the sky
            v2.ColorJitter(brightness=0.3, contrast=0.3, saturation=0.3),
            v2.GaussianBlur(3, sigma=(0.1, 0.8)),
            v2.ToDtype({tv_tensors.Image: torch.float32, "others": None}, scale=True),
        ]
    )


def kornia_pipeline() -> torch.nn.Sequential:
    """Ours before kornia's ``ImageSequential``, one draw for all cameras of the rig."""
    colours = K.ImageSequential(
        K.ColorJiggle(0.2, 0.2, 0.2, 0.02, p=1.0, same_on_batch=True),
        K.RandomGaussianNoise(std=0.02, p=0.5),
    )
    return torch.nn.Sequential(
        RigRetarget(load_rig("waymo").undistorted(), size=(256, 704), geometry="boxes"),
        ResizeRig((128, 352)),
        OnImages(colours),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run both on a synthetic street; with ``--output`` write what came of it."""
    parser = argparse.ArgumentParser(prog="python -m integrations.kornia.example", description=__doc__)
    parser.add_argument("--output", type=Path, help="picture to write")
    arguments = parser.parse_args(argv)
    torch.manual_seed(0)
    sample = SyntheticDrive(demo_source_rig((128, 352)), num_frames=1, lidar=False)[0]
    sample["images"] = tv_tensors.Image(sample["images"])  # else v2 takes the first tensor of the dict for an image
    rows = []
    for pipeline in (torchvision_pipeline(), kornia_pipeline()):
        out = pipeline(sample)
        images = out["images"].as_subclass(torch.Tensor)
        levels = images.float() / (255 if images.dtype == torch.uint8 else 1)
        rows.append(torch.cat(list(levels), dim=-1))
        fx = ", ".join(f"{f:.1f}" for f in out["K"][:, 0, 0])
        print(f"{type(pipeline).__name__}: {tuple(images.shape)} {images.dtype}, fx {fx} px")
    if arguments.output:
        picture = (torch.cat(rows, dim=-2).permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(arguments.output), np.ascontiguousarray(picture))
        print(f"picture: {arguments.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
