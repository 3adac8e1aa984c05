"""Inpainting of a loader's batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from arbiview_aug.inpaint.inpainter import Inpainter


class CompletedLoader:
    """Loader that fills the batches of another one in this process, on the device of the inpainter's network.

    ``loader`` yields batches from ``RigRetarget(..., keys=SampleKeys(extra=("sources", "confidence")))``.
    """

    def __init__(self, loader: Iterable[Mapping[str, Any]], inpainter: Inpainter) -> None:
        self.loader, self.inpainter = loader, inpainter

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for batch in self.loader:
            yield self.inpainter.complete_batch(batch)

    def __len__(self) -> int:
        return len(self.loader)  # type: ignore[arg-type]
