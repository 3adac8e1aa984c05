"""Render plans and their cache, what follows from a pair of rigs, and warnings about targets that it cannot show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np

from arbiview_aug import temporal
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rays import RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import is_mounted, pose_mistake
from arbiview_aug.choices import GeometryName, is_number
from arbiview_aug.errors import GeometryWarning, UnreachableError, WarnOnce
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.overlap_depth import OverlapDepth
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.requirements import needs_geometry, stand_in_view, static_harm
from arbiview_aug.render.view_planner import build_plan, plan_key
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import focal_mistake
from arbiview_aug.scene.scene import GEOMETRIES, Scene

Coverages = Sequence[BoolArray]
"""Coverage (h, w) of each target camera."""

_FINER = 3.0  # readers decode at 1/4, while targets have their full size; 1/2 is a fair trade
_UNREACHABLE = 0.5  # warn of target cameras of which less than this share is covered
_SUSPICIOUS = 0.3  # a rig of which less is covered may have wrong poses


def check_reach(source: Rig, target: Rig, coverages: Coverages, unseen: str, warn: WarnOnce) -> None:
    """Warn once of target cameras that the sources hardly cover; ``unseen`` says what becomes of uncovered pixels.

    Raises:
        UnreachableError: The sources cover none of the target's pixels.
    """
    for topic, message in _unlikely_target(source, target):
        warn(topic, message, GeometryWarning)
    is_empty = not any(map(np.any, coverages))
    if "unreachable" in warn.topics and not is_empty:  # the means below take milliseconds
        return
    lost = f"the target rig {target.name!r} cannot be reached from this data"
    if is_empty:
        cause = _likely_cause(source, target)
        raise UnreachableError(f"{lost}: expected some pixels to be covered, got none. {cause}")
    shares = [np.count_nonzero(covered) / covered.size for covered in coverages]
    poor = [f"{c.name} {share:.0%}" for c, share in zip(target, shares, strict=True) if share < _UNREACHABLE]
    if poor:
        cause = f"{_likely_cause(source, target)}. " if np.mean(shares) < _SUSPICIOUS else ""
        covered = f"covered are {', '.join(poor)}. {cause}{unseen}"
        warn("unreachable", f"{lost}: {covered} Or choose another target", GeometryWarning)


def _unlikely_target(source: Rig, target: Rig) -> Iterator[tuple[str, str]]:
    """Topics and warnings of target cameras that no vehicle has, and of views much finer than the source's images."""
    for camera, mounted in zip(target, is_mounted(target.cam2ego, target.ground_z_m), strict=True):
        where = f"target camera {camera.name!r}"
        if not mounted:
            x, y, z = camera.center_m - (0, 0, target.ground_z_m)
            place = f"({x:.1f}, {y:.1f}) m, {z:.1f} m above the road"
            yield "mounting", f"{where}: expected a place on a vehicle, got {place}; are moves and poses in metres?"
        if mistake := focal_mistake(camera):
            yield "target focal", f"{where}: K: expected a focal length in pixels, got {'; '.join(mistake)}"
    finer = float(np.median(target.K[:, 0, 0]) / source.K[:, 0, 0].max())
    if finer > _FINER:
        views = f"views are {finer:.0f} times as fine as the finest source image, and blurred"
        yield "fine", f"{views}; read the images larger (reduce), or set a smaller size= or a wider field of view"


def _likely_cause(source: Rig, target: Rig) -> str:
    """Why a target sees nothing of the sources, and the fix."""
    hint = "No source camera looks where the target's do, or masks hide it; python -m arbiview_aug check tests the data"
    return _mistaken_poses(source, target) or hint


def _mistaken_poses(source: Rig, target: Rig) -> str:
    """The rig whose poses are probably wrong, and the fix; empty without one."""
    for whose, rig in (("source", source), ("target", target)):
        if mistake := pose_mistake(rig.cam2ego, rig.ground_z_m):
            return f"The {whose}'s cam2ego seems to be {mistake[0]}: {mistake[1]}"
    return ""


@dataclass(frozen=True, kw_only=True)
class PlanCache:
    """Plans that a transform keeps between calls. Pickles and copies are empty: each DataLoader worker fills its own.

    Attributes:
        max_bytes: Memory for plans of calibrations that come back; the least recently used go first.
        share_overlap: Frames that share the depth from overlap of ``quality="accurate"``, which depends on the images:
            False, none; a key of the sample, such as a scene token, those with the same value and calibration; True,
            all of a calibration, which is right for a vehicle at rest alone.

    Raises:
        ValueError: Impossible values.
    """

    max_bytes: int = 512 * 2**20
    share_overlap: bool | str = False

    def __post_init__(self) -> None:
        if not is_number(self.max_bytes) or not self.max_bytes >= 0:
            raise ValueError(f"PlanCache.max_bytes: expected a number of bytes from 0, got {self.max_bytes!r}")
        if not isinstance(self.share_overlap, bool | str):
            raise ValueError(f"PlanCache.share_overlap: expected a bool or a sample key, got {self.share_overlap!r}")


_MAX_RIG_PAIRS = 64  # one or two kilobytes each, beside the target's cameras


class RigPair:
    """A source rig, a target rig in the source's ego frame, and what follows from their calibrations alone."""

    def __init__(self, source: Rig, target: Rig, surface: GeometryName, config: RenderConfig | None) -> None:
        self.source, self.target = source, target.in_frame_of(source)
        self.road = Scene()  # nothing else is known
        self.needs_geometry = config is not None and needs_geometry(source, self.target, surface, config)
        self._surface, self._config = surface, config

    @cached_property
    def road_key(self) -> bytes:
        """Key of the plan over the road alone."""
        return self.plan_key(self.road)

    def plan_key(self, scene: Scene) -> bytes:
        """Key of the plan in a scene."""
        assert self._config is not None
        return plan_key(self.source, self.target, self._surface, self._config, scene)

    @cached_property
    def harm(self) -> str | None:
        """Why a detector suffers if the target is rendered over a static surface; None if it does not."""
        return None if self._config is None else static_harm(self.source, self.target, "street", self._config)


@dataclass(frozen=True, eq=False)
class FramePlan:
    """How one frame is rendered, and from what it was planned."""

    frame: Frame  # the frame
    pair: RigPair  # its rig and the target
    scene: Scene  # geometry of the sample, with estimated depth
    surface: GeometryName  # name of the surface that the target is rendered over, where centres differ
    plan: RenderPlan
    neighbours: Sequence[Neighbour] = ()  # other frames of the drive that may fill holes, the nearest first
    overlap: OverlapDepth | None = None  # depth from overlap, if it was estimated
    motion: temporal.MotionDepth | None = None  # depth from motion, if it was estimated

    @property
    def harm(self) -> str | None:
        """Why a detector suffers from cameras that move over a static surface; None if it does not."""
        if GEOMETRIES[self.surface].is_static or self.pair.harm is None:
            return self.pair.harm
        boxes = self.scene.boxes
        if self.surface != "boxes" or boxes is None or not len(boxes) or stand_in_view(self.pair.source, boxes):
            return None
        lost = f"boxes_3d: most of {len(boxes)} are off the road or in no camera's view (python -m arbiview_aug check)"
        return f"{lost}; {self.pair.harm}"


class Plans:
    """Builds render plans, and caches those of calibrations that come back; ``maps`` are rays and masks of cameras.

    Args:
        config: Settings; None for the paper's stages, which depend on every image and have no plans.
        surface: A name in ``GEOMETRIES``.
        max_bytes: Memory for plans; the least recently used go first.
        keep_refined: Whether plans over a street that depth from overlap corrected come back.
        check_reach: Called with the source, the target and its coverage for each new plan.
    """

    def __init__(
        self,
        config: RenderConfig | None,
        surface: GeometryName,
        max_bytes: int,
        keep_refined: bool,
        check_reach: Callable[[Rig, Rig, Coverages], None],
    ) -> None:
        self.config, self.surface, self.check_reach = config, surface, check_reach
        self.cache: LRUCache[bytes, RenderPlan] = LRUCache(max_bytes, attrgetter("nbytes"))
        self.maps = RayCache()
        self._keep_refined = keep_refined
        self._pairs: LRUCache[tuple[bytes, bytes], RigPair] = LRUCache(_MAX_RIG_PAIRS)

    def pair(self, source: Rig, target: Rig) -> RigPair:
        """The pair of a source and a target rig; cached."""
        key = source.named_key, target.named_key
        return self._pairs.get(key, lambda: RigPair(source, target, self.surface, self.config))

    def plan(self, pair: RigPair, scene: Scene) -> RenderPlan:
        """The plan of a pair in a scene; cached without a frame's own geometry. A scene that no
        pixel depends on is ignored.

        Raises:
            ValueError: There are no plans.
        """
        if self.config is None:
            raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")
        if scene.is_empty or not pair.needs_geometry:
            return self.cache.get(pair.road_key, lambda: self._built(pair, pair.road))
        if self._keep_refined and scene.best == "street":
            return self.cache.get(pair.plan_key(scene), lambda: self._built(pair, scene))
        return self._built(pair, scene)  # a frame's own geometry never comes back

    def _built(self, pair: RigPair, scene: Scene) -> RenderPlan:
        source, target = pair.source, pair.target
        plan = build_plan(source, target, geometry=self.surface, config=self.config, scene=scene, maps=self.maps)
        coverage = plan.coverage
        # Objects may hide all of a frame's target, if its cameras are where they should be.
        if not scene.is_empty and not any(map(np.any, coverage)) and not _mistaken_poses(source, target):
            coverage = build_plan(source, target, geometry="street", config=self.config, maps=self.maps).coverage
        self.check_reach(source, target, coverage)
        return plan
