"""Each stage's file cites its section of the paper, and the functions that it names there exist."""

import re
from importlib import import_module

import pytest

STAGES = {
    "stage1_geometry": "Stage 1: Geometric Transformation Foundation",
    "stage2_features": "Stage 2: Feature Matching Optimization",
    "stage3_objects": "Stage 3: Object Alignment Fine-tuning",
    "stage4_fusion": "Stage 4: Adaptive Fusion Generation",
}


@pytest.mark.parametrize("name", STAGES)
def test_stages_cite_the_paper(name: str) -> None:
    module = import_module(f"arbiview_aug.favs.{name}")
    words = " ".join(module.__doc__.split())
    assert '"Feature-Aware Adaptive View Synthesis (FAVS) Algorithm"' in words and f'"{STAGES[name]}"' in words
    (equations,) = (part for part in module.__doc__.split("\n\n") if part.startswith("- "))
    functions = re.findall(r"``(\w+)(?:\.weight)?``", equations)
    assert len(functions) >= 3 and all(hasattr(module, function) for function in functions)
