"""``python -m integrations.lightning.example``: a toy model trained on a synthetic street as a van sees it."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils.data import DataLoader

from arbiview_aug import RigRetarget, collate
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from integrations.environments import required

required("lightning")
import lightning  # noqa: E402


class RetargetDataModule(lightning.LightningDataModule):
    """Workers read; batches are retargeted on the device that trains. Validation frames are vehicle B's own."""

    def __init__(self, train: Any, val: Any, retarget: RigRetarget, batch_size: int = 2) -> None:
        super().__init__()
        self.train, self.val, self.retarget, self.batch_size = train, val, retarget, batch_size

    def train_dataloader(self) -> DataLoader[Any]:
        """Vehicle A's frames."""
        return DataLoader(self.train, self.batch_size, shuffle=True, collate_fn=collate)

    def val_dataloader(self) -> DataLoader[Any]:
        """Vehicle B's frames."""
        return DataLoader(self.val, self.batch_size, collate_fn=collate)

    def transfer_batch_to_device(self, batch: dict[str, Any], device: torch.device, dataloader_idx: int) -> Any:
        """Move the images alone: plans are made on the CPU, from calibration in float64."""
        return {**batch, "images": batch["images"].to(device)}

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Retarget on the device, before the training step."""
        return self.retarget(batch) if self.trainer.training else batch


class MeanColour(lightning.LightningModule):
    """A model that learns the mean colour of the images."""

    def __init__(self) -> None:
        super().__init__()
        self.colour = torch.nn.Parameter(torch.full((3, 1, 1), 0.5))

    def training_step(self, batch: dict[str, Any], index: int) -> torch.Tensor:
        """On retargeted frames."""
        return (batch["images"].float() / 255 - self.colour).square().mean()

    def validation_step(self, batch: dict[str, Any], index: int) -> None:
        """On frames as they are."""
        self.log("val_loss", self.training_step(batch, index), batch_size=len(batch["images"]))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.parameters(), 1e-2)


def main() -> int:
    """Train on a sedan's frames as a van's."""
    target = demo_target_rig((64, 176))
    data = RetargetDataModule(
        SyntheticDrive(demo_source_rig((64, 176)), num_frames=4, lidar=False),
        SyntheticDrive(target, num_frames=2, seed=1, lidar=False),
        RigRetarget(target, geometry="boxes"),
    )
    trainer = lightning.Trainer(max_epochs=2, logger=False, enable_checkpointing=False, enable_progress_bar=False)
    trainer.fit(MeanColour(), data)
    print(f"validation loss {float(trainer.callback_metrics['val_loss']):.3f}, on {trainer.strategy.root_device}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
