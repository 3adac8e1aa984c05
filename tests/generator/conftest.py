"""A small generator that the tests share."""

from __future__ import annotations

import pytest
import torch

from arbiview_aug.generator import Generator
from tests.generator.small import small_config, stirred


@pytest.fixture(scope="session")
def generator() -> Generator:
    """Not to be changed."""
    torch.manual_seed(0)
    made = Generator.from_config(small_config())
    stirred(made.denoiser)
    return made.eval()
