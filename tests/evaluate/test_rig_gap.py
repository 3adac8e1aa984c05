"""How far apart two rigs are: by hand where a formula is known."""

import math

import pytest

from arbiview_aug import Camera, Rig, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.evaluate.rig_gap import rig_gap


def ring(height_m: float = 1.5, fov_deg: float = 70.0, width_px: int = 640) -> Rig:
    return Rig(
        [
            Camera.looking(
                name=f"c{k}",
                azimuth_deg=60.0 * k,
                position_m=(0, 0, height_m),
                width_px=width_px,
                height_px=width_px // 2,
                horizontal_fov_deg=fov_deg,
            )
            for k in range(6)
        ]
    )


def test_a_rig_is_no_distance_from_itself_at_any_resolution_or_road():
    for target in (ring(), ring(width_px=320), load_moved(ring())):
        gap = rig_gap(ring(), target)
        assert tuple(gap) == pytest.approx((0, 0, 0), abs=2e-3)


def load_moved(rig: Rig) -> Rig:
    """The same cameras in an ego frame one metre higher."""
    return Rig(list(rig.shifted(z_m=-1)), ground_z_m=-1.0)


def test_height_changes_what_rows_tell_and_the_field_of_view_what_sizes_tell():
    higher = rig_gap(ring(), ring(height_m=2.2))
    assert higher.row == pytest.approx(math.log(2.2 / 1.5), abs=1e-6) and higher.size < 0.01
    assert higher.unseen == 0
    zoomed = rig_gap(ring(), ring(fov_deg=61.0))
    assert zoomed.size == pytest.approx(math.log(math.tan(math.radians(35)) / math.tan(math.radians(30.5))), abs=0.02)
    assert zoomed.row == pytest.approx(zoomed.size, abs=0.05)


def test_what_the_source_never_sees_is_a_share_of_what_the_target_sees():
    front = Rig([ring()[0]])
    assert rig_gap(front, ring()).unseen > 0.7
    assert rig_gap(ring(), front).unseen == 0
    behind = rig_gap(front, Rig([ring()[3]]))
    assert behind.unseen == 1 and math.isnan(behind.row)
    assert "sees none of the objects in the other's images" in str(behind) and "nan" not in str(behind)


@pytest.mark.filterwarnings("error")
def test_cameras_below_the_road_have_a_finite_gap():
    for source, target in ((ring(height_m=-1), ring()), (ring(), ring(height_m=-1))):
        gap = rig_gap(source, target)
        assert gap.unseen < 1 and gap.row == pytest.approx(math.log(4))


def test_shipped_rigs_with_lenses():
    for name in ("fisheye_surround", "argoverse2", "ddad"):
        gap = rig_gap(load_rig("nuscenes"), load_rig(name))
        assert 0 <= gap.unseen <= 1 and 0 < gap.row < 1.4 and 0 < gap.size < 1.4


def test_inspect_says_it(capsys, tmp_path):
    assert main(["inspect", "nuscenes", "waymo", "--output", str(tmp_path / "rigs.png")]) == 0
    out = capsys.readouterr().out
    assert "1.6 m high, 5 to 40 m away in the other rig's images: the first rig does not see 0%" in out
    assert "distances are wrong by 87% of the true ones by objects' rows, by 34% by their sizes" in out
