"""``python -m integrations.kornia.example``: retarget, crop, then change colours, by torchvision and by kornia."""

from __future__ import annotations

import kornia.augmentation as K
import torch
from torchvision import tv_tensors
from torchvision.transforms import v2

from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.kornia import OnImages


def torchvision_pipeline() -> v2.Compose:
    """Ours inside ``v2.Compose``: photometric transforms after it see a ``tv_tensors.Image``."""
    return v2.Compose(
        [
            RigRetarget(load_rig("waymo").undistorted(), size=(128, 352), geometry="boxes"),  # the sky is cropped
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
        RigRetarget(load_rig("waymo").undistorted(), size=(128, 352), geometry="boxes"),
        OnImages(colours),
    )


def main() -> int:
    """Run both on a synthetic street."""
    torch.manual_seed(0)
    sample = SyntheticDrive(demo_source_rig((128, 352)), num_frames=1, lidar=False)[0]
    sample["images"] = tv_tensors.Image(sample["images"])  # else v2 takes the first tensor of the dict for an image
    for pipeline in (torchvision_pipeline(), kornia_pipeline()):
        out = pipeline(sample)
        fx = ", ".join(f"{f:.1f}" for f in out["K"][:, 0, 0])
        print(f"{type(pipeline).__name__}: {tuple(out['images'].shape)} {out['images'].dtype}, fx {fx} px")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
