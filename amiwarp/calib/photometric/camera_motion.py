"""Steps of the photometric stage for a camera that moves: the scenes of tiles move on paths of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.tile_paths import FAST_PATH_TERMS, PATH_TERMS, TilePaths
from amiwarp.results.parameters import MOTION

LARGEST_OF_LEAST = 2.0
"""A tile whose scene moves on its own path is left out if its cost is over this multiple of the least cost of a tile,
and over :data:`limits.LARGEST_STILL_COST`."""


def follow_a_fast_camera(state: Refinement) -> Refinement:
    """End with an answer for tiles whose scenes move on their own paths."""
    free = _with_free_paths(state, FAST_PATH_TERMS)
    values = state.space.to_values(state.answer.x)
    answer = free.search.search(free.space.to_vector(values))
    return replace(free, answer=answer).ending()


def follow_a_slow_camera(state: Refinement) -> Refinement:
    """Let the scenes of tiles move on their own paths, if these explain much of the residual.

    The camera's rotation stays as it was found; the paths add what it lacks: a rotation that varies faster, and
    parallax. Tiles that are not explained then, such as the tiles of a moving object, are left out.
    """
    space = state.space
    only_motion_is_free = set(space.names).issubset(MOTION)
    tiles = len(state.search.cost.brightness.tiles.origin)
    if only_motion_is_free or tiles == 1:
        return state

    free = _with_free_paths(state, PATH_TERMS)
    cost = free.search.cost
    paths = cost.paths
    assert paths is not None
    values = space.to_values(state.answer.x)
    v = free.space.to_vector(values)
    cost.slopes(v)
    if paths.gain() <= limits.LARGEST_ROTATION_GAIN:
        state.search.cost.converge(state.answer.x)
        return state
    v = free.search.descend(v).x
    cost.residuals(v, rounds=2)

    # Leave out tiles that are not explained.
    costs = paths.costs(cost.scale)
    with_pairs = costs > 0.0
    least = float(costs[with_pairs].min())
    largest = max(limits.LARGEST_STILL_COST, LARGEST_OF_LEAST * least)
    keep = costs <= largest
    if not keep[with_pairs].all():
        free = _on_tiles(free, keep, v)
    answer = free.search.search(v)
    return replace(free, answer=answer)


def _with_free_paths(state: Refinement, terms: int) -> Refinement:
    """Return the state with paths of the tiles by ``terms`` powers of time, and the camera's motion held.

    The answer is still the one before; the map is solved at it.
    """
    cost = state.search.cost
    motion = tuple(name for name in state.space.names if name in MOTION)
    values = state.space.to_values(state.answer.x)
    held = {name: values[name] for name in motion}
    space = state.space.without(motion).holding(held)
    paths = TilePaths(cost.brightness, terms)
    with_paths = cost.in_space(space, paths)
    with_paths.residuals(space.to_vector(values), rounds=2)
    rotation = {name: state.answer.uncertainty[name] for name in motion}
    search = replace(state.search, cost=with_paths)
    return replace(state, search=search, rotation=rotation)


def _on_tiles(state: Refinement, keep: np.ndarray, v: np.ndarray) -> Refinement:
    """Return the state with the pairs of some tiles only, on a new map that is solved at ``v``."""
    before = state.search.cost
    assert before.paths is not None
    pairs = state.equations.pairs.of_tiles(keep)
    equations = replace(state.equations, pairs=pairs)
    on_new_map = equations.cost_on(before.brightness.tiles, before.space)
    paths = TilePaths(on_new_map.brightness, PATH_TERMS)
    paths.set(before.paths.moved_px)
    cost = on_new_map.in_space(before.space, paths)
    cost.warm_up(v)
    search: AnswerSearch = replace(state.search, cost=cost)
    return replace(state, equations=equations, search=search)
