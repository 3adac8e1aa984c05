"""Retargeting of whole batches on the training device: a Lightning DataModule, and the collation below it."""

from typing import TYPE_CHECKING, Any

from arbiview_aug.sample.collate import collate

if TYPE_CHECKING:
    from arbiview_aug.integrations.lightning.datamodule import RetargetDataModule

__all__ = ["RetargetDataModule", "collate"]


def __getattr__(name: str) -> Any:
    if name != "RetargetDataModule":  # needs lightning, collate does not
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from arbiview_aug.integrations.lightning.datamodule import RetargetDataModule

    return RetargetDataModule
