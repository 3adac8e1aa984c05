"""Studies, and checks of times, memory, accuracy and kills (docs/contributing.md); fixtures are the tests'."""

from tests.conftest import (  # noqa: F401
    data_root,
    ddad_root,
    fisheye_root,
    kitti_root,
    nuscenes_root,
    referee,
    report_bound,
)
