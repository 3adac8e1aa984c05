"""``python -m integrations.lightning.example``: two epochs of a toy model on a synthetic street seen by a van."""

from __future__ import annotations

from typing import Any

import torch

from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from integrations.environments import required

required("lightning")
import lightning  # noqa: E402

from arbiview_aug.integrations.lightning import RetargetDataModule  # noqa: E402

SIZE = (64, 176)


class NearestBox(lightning.LightningModule):
    """Says how far the nearest labelled object is, from all images; what no camera saw is not looked at."""

    def __init__(self) -> None:
        super().__init__()
        self.features = torch.nn.Sequential(
            torch.nn.Conv2d(3, 8, 5, stride=4), torch.nn.ReLU(), torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten()
        )
        self.head = torch.nn.Linear(8, 1)
        self.shapes: list[tuple[str, tuple[int, ...]]] = []

    def _loss(self, batch: dict[str, Any]) -> torch.Tensor:
        images = batch["images"].float() / 255
        features = self.features(images.flatten(0, 1)).reshape(*images.shape[:2], -1).mean(1)
        nearest_m = torch.stack([boxes[:, :2].norm(dim=1).min() for boxes in batch["boxes_3d"]])
        return torch.nn.functional.l1_loss(self.head(features)[:, 0], nearest_m)

    def training_step(self, batch: dict[str, Any], index: int) -> torch.Tensor:
        """On retargeted frames."""
        self.shapes.append(("train", tuple(batch["images"].shape)))
        assert batch["coverage"].device == batch["images"].device
        return self._loss(batch)

    def validation_step(self, batch: dict[str, Any], index: int) -> None:
        """On frames as they are."""
        self.shapes.append(("val", tuple(batch["images"].shape)))
        self.log("val_l1_m", self._loss(batch), batch_size=len(batch["images"]))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.parameters(), 1e-2)


def main() -> int:
    """Train on a sedan's frames as a van's, validate on the van's own."""
    target = demo_target_rig(SIZE)
    data = RetargetDataModule(
        SyntheticDrive(demo_source_rig(SIZE), num_frames=4, lidar=False),
        SyntheticDrive(target, num_frames=2, seed=1, lidar=False),
        RigRetarget(target, geometry="boxes"),
        batch_size=2,
    )
    model = NearestBox()
    trainer = lightning.Trainer(
        max_epochs=2,
        accelerator="auto",
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(model, data)
    off_m = float(trainer.callback_metrics["val_l1_m"])
    print(f"{model.shapes}\nvalidation: {off_m:.1f} m off, on {trainer.strategy.root_device}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
