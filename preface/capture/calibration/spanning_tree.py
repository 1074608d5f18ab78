"""From cameras that stand alone to a rig: poses along the spanning tree of the most shared points.

Every frame that two cameras share says how they stand to one another. Only frames that agree on it count, so
that a camera whose images were swapped, shifted in time, or taken while it moved is not chained to the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from preface.capture.calibration.errors import CalibrationError
from preface.capture.calibration.initial import Alone
from preface.capture.calibration.normal_equations import residuals
from preface.capture.calibration.state import RigState
from preface.capture.calibration.views import BoardViews
from preface.geometry.transforms import Rigid

# A frame that two cameras share gives their relative pose; a second one confirms it.
MIN_AGREEING_FRAMES = 2
# Cameras alone are some 0.1% off in focal length and 1% in principal point: poses that agree place a board
# within this share of the image of one another.
AGREEMENT = 0.03
# Relative poses that are tried, and boards at which they are compared, per pair of cameras.
MAX_HYPOTHESES = 50
MAX_PROBES = 60


@dataclass(frozen=True, eq=False)
class Link:
    """How two cameras stand to one another.

    Attributes:
        target_from_source: the relative pose on which the most frames agree.
        shared: number of frames that both see the board in.
        agreeing: number of those that agree.
        points: number of points that both see in shared frames.
    """

    target_from_source: Rigid
    shared: int
    agreeing: int
    points: int


def assemble(
    alone: Alone, camera_ids: tuple[str, ...], image_sizes: tuple[tuple[int, int], ...]
) -> tuple[RigState, np.ndarray]:
    """Chain the cameras to a rig in the frame of the first, and place each board.

    Returns:
        the rig, and the trusted sightings [V, P] of those views that it explains roughly.

    Raises:
        CalibrationError: the cameras fall apart into groups that share no frames, or none that agree.
    """
    views, poses = alone.views, alone.state.rig_from_board  # camera_from_board of each view
    limit = AGREEMENT * np.max(image_sizes, axis=1)
    links = _links(views, alone.trusted, poses, limit / alone.state.params[:, 0])
    parents, order = _tree(links, views.cameras, camera_ids)
    rotation, translation = np.tile(np.eye(3), (views.cameras, 1, 1)), np.zeros((views.cameras, 3))
    for camera in order[1:]:
        parent = parents[camera]
        link = links[min(camera, parent), max(camera, parent)].target_from_source
        step = link if camera > parent else link.inverse
        pose = step @ Rigid(rotation[parent], translation[parent])
        rotation[camera], translation[camera] = pose.rotation, pose.translation
    camera_from_rig = Rigid(rotation, translation)
    boards, medians = _place_boards(views, alone, camera_from_rig, limit)
    explained = medians <= limit[views.camera]
    state = RigState(alone.state.model, alone.state.params, camera_from_rig, boards, alone.state.warp)
    return state, alone.trusted & explained[:, None]


def _links(
    views: BoardViews, trusted: np.ndarray, camera_from_board: Rigid, limit: np.ndarray
) -> dict[tuple[int, int], Link]:
    """Relate all pairs of cameras that share a frame: links[source, target], source < target."""
    view_at = np.full((views.cameras, views.frames), -1)
    view_at[views.camera, views.frame] = np.arange(len(views))
    links = {}
    for source in range(views.cameras):
        for target in range(source + 1, views.cameras):
            both = (view_at[source] >= 0) & (view_at[target] >= 0)
            if both.any():
                of_source, of_target = view_at[source, both], view_at[target, both]
                pose, agreeing = _relative_pose(
                    _at(camera_from_board, of_target),
                    _at(camera_from_board, of_source),
                    float(np.abs(views.points).max()),
                    limit[target],
                )
                points = int((trusted[of_source] & trusted[of_target]).sum())
                links[source, target] = Link(pose, int(both.sum()), agreeing, points)
    return links


def _relative_pose(in_target: Rigid, in_source: Rigid, extent: float, limit: float) -> tuple[Rigid, int]:
    """Return the target_from_source on which most frames agree, and how many do.

    Args:
        in_target, in_source: N poses each of the board in the two cameras.
        extent: half the board's size, metres.
        limit: the greatest angle, radians, as the target sees it, by which agreeing poses misplace a board.
    """
    candidates = in_target @ in_source.inverse
    middles = in_source.translation
    probes = np.concatenate([middles + offset for offset in extent * np.eye(3)[:2]] + [middles])
    probes = probes[:: -(-len(probes) // MAX_PROBES)]
    moved = probes @ np.swapaxes(candidates.rotation, -1, -2) + candidates.translation[:, None]  # [N, K, 3]
    tried = np.arange(0, len(moved), -(-len(moved) // MAX_HYPOTHESES))
    depth = np.abs(moved[..., 2]).mean()
    apart = np.array([np.linalg.norm(moved - moved[i], axis=-1).mean(axis=-1) for i in tried]) / depth
    agreeing = (apart <= limit).sum(axis=1)
    best = np.lexsort((np.median(apart, axis=1), -agreeing))[0]
    return _at(candidates, tried[best]), int(agreeing[best])


def _tree(
    links: dict[tuple[int, int], Link], cameras: int, camera_ids: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return each camera's parent, and the cameras in breadth-first order from the first."""
    # The heaviest tree is the lightest one of the reciprocal weights.
    lightness = np.zeros((cameras, cameras))
    for pair, link in links.items():
        if link.agreeing >= MIN_AGREEING_FRAMES:
            lightness[pair] = 1 / (link.agreeing * (1 + link.points / link.shared))
    count, group = connected_components(csr_array(lightness), directed=False)
    if count > 1:
        raise CalibrationError(_apart(group, links, camera_ids))
    order, parents = breadth_first_order(minimum_spanning_tree(csr_array(lightness)), 0, directed=False)
    return parents, order


def _apart(group: np.ndarray, links: dict[tuple[int, int], Link], camera_ids: tuple[str, ...]) -> str:
    """Describe groups of cameras that nothing connects, and the pair that comes closest to doing so."""
    names = np.array(camera_ids)
    groups = "; ".join(
        ", ".join(f"'{name}'" for name in names[group == g]) for g in range(int(group.max()) + 1)
    )
    across = {pair: link for pair, link in links.items() if group[pair[0]] != group[pair[1]]}
    nearest = max(across, key=lambda pair: across[pair].shared, default=None)
    start = f"cameras: they fall apart into {int(group.max()) + 1} groups that no board connects ({groups}). "
    if nearest is None:
        a, b = names[np.flatnonzero(group == 0)[0]], names[np.flatnonzero(group == 1)[0]]
        return (
            start
            + f"No two of different groups share a frame (the first two, '{a}' and '{b}', have 0 shared "
            "frames); show the board to both at the same time, or check that frames are named alike"
        )
    shared = across[nearest].shared
    pair = f"'{names[nearest[0]]}' and '{names[nearest[1]]}'"
    frames = f"{shared} shared frame{'s' * (shared != 1)}"
    if shared < MIN_AGREEING_FRAMES:
        return (
            start + f"The nearest pair is {pair} with {frames}; show the board to both at the same time in "
            f"{MIN_AGREEING_FRAMES} or more, or check that frames are named alike"
        )
    return (
        start
        + f"The nearest pair is {pair} with {frames}, but no two of those agree on how the cameras stand "
        "to one another: were images swapped, frames shifted in time, or was a camera moved?"
    )


def _place_boards(
    views: BoardViews, alone: Alone, camera_from_rig: Rigid, limit: np.ndarray
) -> tuple[Rigid, np.ndarray]:
    """Put each frame's board where one of its views has it: where it suits most views best.

    Returns:
        rig_from_board [F], and the median error of each view [V], pixels.
    """
    rig_from_camera = camera_from_rig.inverse
    proposals = _at(rig_from_camera, views.camera) @ alone.state.rig_from_board
    # Within each frame, the n-th view proposes in round n.
    order = np.argsort(views.frame, kind="stable")
    first = np.searchsorted(views.frame[order], views.frame[order])
    rank = np.empty(len(views), int)
    rank[order] = np.arange(len(views)) - first
    best = np.full(views.frames, np.inf)
    medians = np.full(len(views), np.inf)
    rotation, translation = np.tile(np.eye(3), (views.frames, 1, 1)), np.tile((0.0, 0, 1), (views.frames, 1))
    for turn in range(rank.max() + 1):
        proposing = np.flatnonzero(rank == turn)
        frames = views.frame[proposing]
        asked = np.flatnonzero(np.isin(views.frame, frames))
        trial_rotation, trial_translation = rotation.copy(), translation.copy()
        trial_rotation[frames] = proposals.rotation[proposing]
        trial_translation[frames] = proposals.translation[proposing]
        trial = Rigid(trial_rotation, trial_translation)
        state = RigState(alone.state.model, alone.state.params, camera_from_rig, trial, alone.state.warp)
        lengths = np.linalg.norm(residuals(views.select(asked), state), axis=-1)
        lengths = np.where(np.isnan(lengths), np.inf, lengths)
        median = np.nanmedian(np.where(alone.trusted[asked], lengths, np.nan), axis=1)
        # Views far off count alike, however far: a stray camera must not drag the board towards itself.
        share = np.minimum(median / limit[views.camera[asked]], 1.0)
        cost = np.bincount(views.frame[asked], share, views.frames)
        better = np.zeros(views.frames, bool)
        better[frames] = cost[frames] < best[frames]
        best[better] = cost[better]
        rotation[better], translation[better] = trial_rotation[better], trial_translation[better]
        update = better[views.frame[asked]]
        medians[asked[update]] = median[update]
    return Rigid(rotation, translation), medians


def _at(poses: Rigid, index: np.ndarray | int) -> Rigid:
    return Rigid(poses.rotation[index], poses.translation[index])
