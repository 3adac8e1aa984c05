"""The study runner with a toy method."""

from __future__ import annotations

from functools import partial

import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.frames import make_frame
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, Sample, retargeting
from arbiview_aug.evaluate.report.tables import metric_table
from integrations.benchmarks.study import study


def test_a_row_is_one_method() -> None:
    """A toy that paints everything grey is scored, timed and printed beside the others for one entry in the list."""

    def grey(sample: Sample, target: Rig) -> list[RenderedView]:
        return [RenderedView(np.full((*c.size, 3), 128, np.uint8), np.ones(c.size, bool)) for c in target]

    drive = SyntheticDrive(demo_source_rig((32, 88)), num_frames=1, lidar=False)
    frame = make_frame(drive[0], truth=partial(drive.render, 0), exposures=())
    rig = frame.sample["rig"]
    toy = Method("toy", grey)
    found = study(
        [retargeting("fast", "infinity", "far"), toy],
        [frame],
        {"same": [rig], "turned": [rig.turned(yaw_deg=5)]},
        consistency=True,
    )
    assert list(found) == ["far", "toy"]
    for row in found.values():
        assert len(row["ms"]) == len(row["plan_ms"]) == 2 and min(row["ms"]) >= 0
    assert found["far"]["same"]["true_psnr_db"] > 40 > found["toy"]["same"]["true_psnr_db"] > 3
    agree = [found["far"][kind]["consistency_raw_psnr_db"] for kind in ("same", "turned")]
    assert agree[0] != agree[1], "each set has its own pairs"
    rows = [{"name": name, **row["turned"]} for name, row in found.items()]
    printed = metric_table(rows, [("seen", "{seen:.0%}"), ("dB", "{true_psnr_db:.1f}"), ("never", "{unknown:.1f}")])
    assert printed.splitlines()[-1].startswith("| toy | 100% |") and printed.endswith("    - |")
