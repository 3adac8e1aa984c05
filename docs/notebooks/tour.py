# %% [markdown]
# # A tour
#
# One sample, from your own data to a training loader: check it, ask what retargeting would do, retarget, load, and
# measure. A synthetic street takes the place of your data, so everything runs anywhere in under a minute.

# %%
import math

from torch.utils.data import DataLoader

from arbiview_aug import (
    RetargetedDataset,
    RigRetarget,
    check,
    collate,
    load_rig,
    show,
)
from arbiview_aug.__main__ import main
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig

# %% [markdown]
# ## Your own sample
#
# A sample is a dict. It needs images, intrinsics and poses. Boxes and points in the ego frame (x forward, y left, z up,
# metres) make the views better. [Formats](../formats.md) lists every key.

# %%
rig = demo_source_rig((128, 352))
dataset = SyntheticDrive(rig, num_frames=4, seed=2, lidar=True)
recorded = dataset[0]
keys = "images", "K", "cam2ego", "boxes_3d", "points"
sample = {key: recorded[key] for key in keys}
for key, value in sample.items():
    print(f"{key:9} {tuple(value.shape)} {value.dtype}")

# %% [markdown]
# `show` draws the images with the boxes. Boxes that sit on their objects, with headings (pink) that point forward, are
# the best sign that the calibration is understood.

# %%
show(sample)

# %% [markdown]
# ## Check
#
# `check` finds mistakes that shapes and types do not show. [Check your data](../check.md) lists them.

# %%
print(check(sample))

# %%
in_degrees = sample["boxes_3d"].clone()
in_degrees[:, 6] *= 180 / math.pi
print(check({**sample, "boxes_3d": in_degrees}))

# %% [markdown]
# ## Explain
#
# The target is a rig: a shipped one, a rig file, or a calibration of another tool. `explain` says which camera serves
# which view, over which geometry, and how much of it no camera saw.

# %%
target = load_rig("waymo").undistorted()
retarget = RigRetarget(target, size=(192, 288))
print(retarget.explain(sample))

# %% [markdown]
# ## Retarget
#
# The output is a sample again, with the images and the calibration of the target. Boxes stay as they are, because poses
# come back in the source's ego frame. Waymo's rig has scanners, so `points` are what these would have measured.
# Dimmed pixels were seen by no camera: they are filled, and `coverage` is False there.

# %%
views = retarget(sample)
for key in ("images", "K", "cam2ego", "coverage", "generated", "points"):
    print(f"{key:9} {tuple(views[key].shape)} {views[key].dtype}")

# %%
show(views)

# %% [markdown]
# The same views without boxes, holes filled, as a network gets them:

# %%
show({key: views[key] for key in ("images", "K", "cam2ego")})

# %% [markdown]
# ## Load
#
# `RetargetedDataset` retargets in the DataLoader's workers, if `num_workers` asks for any. `collate` stacks what has
# one shape, and lists the rest.

# %%
retargeted = RetargetedDataset(dataset, retarget)
for batch in DataLoader(retargeted, batch_size=2, collate_fn=collate):
    covered = batch["coverage"].float().mean()
    print(tuple(batch["images"].shape), f"{covered:.1%} covered")
    print([len(boxes) for boxes in batch["boxes_3d"]], "boxes")

# %% [markdown]
# ## Evaluate
#
# The command measures what the views are worth. On a synthetic street the truth is known. On your own data
# (`--data FOLDER`) the scores come from LiDAR points, overlaps, and photographs of other cameras.

# %%
command = "evaluate --size 128x352 --geometry auto street --output tour"
status = main(command.split())

# %% [markdown]
# Next: [choosing the geometry](geometry.py), [when to retarget, and when not to](../when.md), and
# [the viewer](../viewer.md) for whole drives.
