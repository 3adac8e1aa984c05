"""``RetargetDataModule``: training batches become another vehicle's on the device that trains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from arbiview_aug import RigRetarget
from arbiview_aug.environment import optional_package
from arbiview_aug.integrations.lightning import on_device, packed, unpacked
from arbiview_aug.sample.collate import collate

optional_package("lightning")  # or one line that says how to install it
import lightning  # noqa: E402


class RetargetDataModule(lightning.LightningDataModule):
    """Datasets of samples, retargeted in batches after they are on the device.

    Workers only read and decode. With images on a GPU ``RigRetarget`` renders there; the plan of a calibration is made
    once on the CPU and kept on the GPU. Plans over points or boxes are made anew for every frame, on the CPU of this
    one process: there ``RetargetedDataset`` in the workers is faster.

    Args:
        train: Vehicle A's frames: retargeted.
        val: Frames to validate on as they are: vehicle B's own, if there are any.
        retarget: To vehicle B; with ``p < 1`` a whole batch shares one draw.
        batch_size: Frames.
        num_workers: DataLoader workers.
    """

    def __init__(
        self,
        train: Dataset[Any],
        val: Dataset[Any],
        retarget: RigRetarget,
        *,
        batch_size: int = 4,
        num_workers: int = 0,
    ) -> None:
        super().__init__()
        self.train, self.val, self.retarget = train, val, retarget
        self.batch_size, self.num_workers = batch_size, num_workers

    def train_dataloader(self) -> DataLoader[Any]:
        """Vehicle A's frames, shuffled, as they are read."""
        return self._loader(self.train, shuffle=True)

    def val_dataloader(self) -> DataLoader[Any]:
        """Frames to validate on."""
        return self._loader(self.val, shuffle=False)

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """The batch stage: on the device, before the training step."""
        samples = unpacked(batch)
        images = samples["images"]
        device = (images if isinstance(images, torch.Tensor) else images[0]).device
        return on_device(self.retarget(samples) if self.trainer.training else samples, device)

    def _loader(self, dataset: Dataset[Any], *, shuffle: bool) -> DataLoader[Any]:
        return DataLoader(
            dataset, self.batch_size, shuffle=shuffle, num_workers=self.num_workers, collate_fn=_packed_batch
        )


def _packed_batch(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return packed(collate(samples))
