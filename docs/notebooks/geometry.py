# %% [markdown]
# # Choosing the geometry
#
# A camera that only turns or zooms needs no geometry. If it moves, each pixel needs a distance, and
# `geometry=` says where that comes from. This notebook renders one street over several of them, and compares with the
# truth, which a synthetic street knows.

# %%
import math

import matplotlib.pyplot as plt

from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig

source = demo_source_rig((128, 352))
drive = SyntheticDrive(source, num_frames=1, seed=2, lidar=True)
sample = drive[0]

GEOMETRIES = "infinity", "ground", "street", "boxes", "lidar"


def compare(target, geometries=GEOMETRIES):
    """Print PSNR and coverage by geometry; return the views, and the truth."""
    truth, outs = drive.render(0, target).images, {}
    for geometry in geometries:
        retarget = RigRetarget(target, geometry=geometry, holes="black")
        views = outs[geometry] = retarget(sample)
        seen = views["coverage"][:, None].expand_as(truth)
        errors = (views["images"].float() - truth.float())[seen]
        psnr = 10 * math.log10(255**2 / errors.square().mean().item())
        covered = seen.float().mean()
        print(f"{geometry:9} {psnr:5.1f} dB  {covered:6.1%} covered")
    return outs, truth


# %% [markdown]
# ## Cameras that turn
#
# Each camera tilts by 3 degrees in its place. Rays keep their starts, so distances hardly matter.

# %%
outs, truth = compare(source.turned(pitch_deg=3.0))

# %% [markdown]
# Turned to the left by 10 degrees, a view also shows what only the next camera saw. That one is in another place, so
# this strip needs distances.

# %%
outs, truth = compare(source.turned(yaw_deg=10.0))

# %% [markdown]
# ## Cameras that rise
#
# Now all cameras are 0.7 m higher, as on a van. Distances matter.

# %%
raised = source.with_cameras([camera.shifted(z_m=0.7) for camera in source])
outs, truth = compare(raised)

# %% [markdown]
# The front camera shows why. Over `infinity` nothing changes its place. Over the `street` the road is right, and
# vehicles stretch, because they are painted onto the road. `boxes` puts labelled objects upright. `lidar` knows what
# was measured. Black is what no camera saw. `infinity` covers everything, and is wrong.

# %%
pictures = {name: views["images"][0] for name, views in outs.items()}
pictures["the truth"] = truth[0]
figure, grid = plt.subplots(2, 3, figsize=(12, 4), layout="constrained")
for axes, (name, picture) in zip(grid.flat, pictures.items(), strict=True):
    axes.imshow(picture.permute(1, 2, 0).numpy())
    axes.set_title(name)
    axes.set_axis_off()

# %% [markdown]
# ## What the sample offers decides
#
# `auto`, the default, takes the best geometry that a sample has keys for, for each pair of cameras. `explain` names
# it. Without boxes and points only the street is left; a call then warns that this harms a detector.

# %%
for keys in (("points", "boxes_3d"), ("boxes_3d",), ()):
    offered = {key: sample[key] for key in ("images", "rig", *keys)}
    explained = str(RigRetarget(raised).explain(offered)).splitlines()
    print(" and ".join(keys) or "images alone", explained[2], sep="\n")

# %% [markdown]
# ## The rule
#
# | cameras | samples have | geometry |
# | --- | --- | --- |
# | turn, zoom | anything | `auto`, which takes `infinity` |
# | move | LiDAR | `auto`, which takes `lidar`, with boxes if there are any |
# | move | boxes alone | `auto`, which takes `boxes` |
# | move | images of a drive with poses | the `depth` command, then `motion` |
# | move | images alone | `auto`, with half of the samples untouched; or depth of a network and `learned` |
#
# [When to retarget](../when.md) says how much of a detector's gap each closes, and
# [depth source and quality](../surfaces.md) says how each works. Your own drive has no truth to compare with: there,
# `evaluate --held-out next` takes the photographs of the next frame instead.
