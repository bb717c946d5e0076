"""Association of corner events to tracks, in their order. Each track is in the list of the cell of its last event."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class CornerChains:
    """Corner events, and the lists of the tracks in each cell of a grid whose cells are as large as the radius."""

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    t: wp.array(dtype=wp.int64)
    cell: wp.array(dtype=int)  # of each event; cells at the border of the grid are empty
    columns: int
    radius: wp.float64
    gap: wp.int64
    head: wp.array(dtype=int)  # first track of each cell, or -1
    after: wp.array(dtype=int)  # next track in the list of each track, or -1
    last: wp.array(dtype=int)  # last event of each track


@wp.func
def unlink(chains: CornerChains, cell: int, before: int, track: int):
    """Remove a track from the list of a cell, in which it follows the track ``before``, or is the first for -1."""
    if before < 0:
        chains.head[cell] = chains.after[track]
    else:
        chains.after[before] = chains.after[track]


@wp.func
def remove(chains: CornerChains, track: int):
    """Remove a track from the list of the cell of its last event."""
    cell, before = chains.cell[chains.last[track]], int(-1)
    at = int(chains.head[cell])
    while at != track:
        before = int(at)
        at = int(chains.after[at])
    unlink(chains, cell, before, track)


@wp.func
def remove_old(chains: CornerChains, cell: int, now: wp.int64):
    """Remove the tracks of a cell whose last event is too old."""
    before, track = int(-1), int(chains.head[cell])
    while track >= 0:
        if now - chains.t[chains.last[track]] > chains.gap:
            unlink(chains, cell, before, track)
        else:
            before = int(track)
        track = int(chains.after[track])


@wp.func
def nearest_track(chains: CornerChains, i: int) -> int:
    """Return the track whose last event is nearest to event ``i``, or -1 if none is within radius and gap."""
    best, least = int(-1), wp.float64(chains.radius * chains.radius)
    for k in range(9):
        cell = chains.cell[i] + (k / 3 - 1) * chains.columns + k % 3 - 1
        remove_old(chains, cell, chains.t[i])
        track = int(chains.head[cell])
        while track >= 0:
            dx = chains.x[chains.last[track]] - chains.x[i]
            dy = chains.y[chains.last[track]] - chains.y[i]
            square = dx * dx + dy * dy
            best, least = wp.where(square <= least, track, best), wp.min(least, square)
            track = int(chains.after[track])
    return best


@wp.kernel
def link_events(chains: CornerChains, number: wp.array(dtype=int)):
    """Write the number of each event's track. One thread takes all events."""
    tracks = int(0)
    for i in range(chains.t.shape[0]):
        track = nearest_track(chains, i)
        if track < 0:
            track = int(tracks)
            tracks += 1
        else:
            remove(chains, track)
        chains.last[track] = i
        chains.after[track] = chains.head[chains.cell[i]]
        chains.head[chains.cell[i]] = track
        number[i] = track
