"""Ways to falsify what a session records or states, at the level of observations, with the cause to be named."""

from dataclasses import replace

import numpy as np

from lrfcal_lib.evaluate.alternatives import ALTERNATIVES


def scaled(**sizes):
    """Statements that are wrong by factors: 'squares', 'outline', 'ranges', 'bearings'."""

    def change(obs):
        for kind, value in sizes.items():
            obs = ALTERNATIVES[kind].change(obs, value)
        return obs

    return change


def changed(**new):
    """Fields that become a function of themselves."""
    return lambda obs: replace(obs, **{name: function(getattr(obs, name)) for name, function in new.items()})


def pitched(function):
    """All recorded pitch angles."""
    return changed(face_pitch=function, beam_pitch=function, view_pitch=function, middle=function)


def of_one(group, field, function, placement=2):
    """A field of one placement's scans or images (by index) as a function of itself."""

    def change(obs):
        values, mine = getattr(obs, f"{group}_{field}").copy(), getattr(obs, f"{group}_placement") == placement
        values[mine] = function(values[mine])
        return replace(obs, **{f"{group}_{field}": values})

    return change


def both(*changes):
    """One change after the other."""

    def change(obs):
        for one in changes:
            obs = one(obs)
        return obs

    return change


def exchanged(values, a=1, b=3):
    """Two numbers exchanged."""
    return np.select([values == a, values == b], [b, a], values)


def moved(pose, by=(0.0, 0.0, 0.15)):
    """Board poses put elsewhere, metres."""
    out = pose.copy()
    out[:, :3, 3] += by
    return out


def longer_lens(obs, camera=1, factor=1.03):
    """A focal length stated too long puts one camera's boards farther away."""
    pose = obs.view_pose.copy()
    pose[obs.view_camera == camera, 2, 3] *= factor
    return replace(obs, view_pose=pose)


def late(obs, by=0.005):
    """Pitch of scan lines that lags behind the motion, radians."""
    return ALTERNATIVES["lag"].change(obs, -by)


def knocked(obs):
    """One camera 30 mm aside from the middle of the recording on."""
    pose = obs.view_pose.copy()
    pose[(obs.view_camera == 0) & (obs.view_placement >= len(obs.placements) // 2), 0, 3] += 0.03
    return replace(obs, view_pose=pose)


# what was done: change of the observations, kinds of reasons of which one has to be given (none: it must do no harm)
FALSIFIED = {
    "squares 2 % too large": (scaled(squares=0.02), ("squares", "ranges")),
    "squares 5 % too small": (scaled(squares=-0.05), ("squares", "ranges")),
    "outline 3 % too large": (scaled(outline=0.03), ("outline",)),
    "outline 3 % too small": (scaled(outline=-0.03), ("outline",)),
    "board and squares 5 % too large": (scaled(outline=0.05, squares=0.05), ("ranges",)),
    "board and squares 2 % too small": (scaled(outline=-0.02, squares=-0.02), ("ranges",)),
    "ranges 1 % too long": (scaled(ranges=0.01), ("ranges",)),
    "ranges 2 % too short": (scaled(ranges=-0.02), ("ranges",)),
    "ranges 60 mm too long": (changed(face_range=lambda r: r + 0.06), ("range offset",)),
    "angular step 3 % too small": (scaled(bearings=0.03), ("bearings",)),
    "angular step 2 % too large": (scaled(bearings=-0.02), ("bearings",)),
    "bearings mirrored": (
        changed(face_bearing=lambda b: np.pi - b, beam_bearing=lambda b: np.pi - b), ("far from stated",)
    ),
    "pitch reversed": (pitched(np.negative), ("far from stated",)),
    "pitch 3 % too small": (pitched(lambda p: 0.97 * p), ("pitch scale",)),
    "pitch in grads instead of degrees": (pitched(lambda p: p / 0.9), ("pitch scale",)),
    "images of two placements exchanged": (changed(view_placement=exchanged), ("excluded",)),
    "scans of two placements exchanged": (
        changed(face_placement=exchanged, beam_placement=exchanged), ("excluded",)
    ),
    "board moved between scan and images": (of_one("view", "pose", moved), ("excluded", "misfit")),
    "board leant over between scan and images": (
        of_one("face", "range", lambda r: r + np.linspace(0, 0.1, len(r))), ("excluded", "misfit")
    ),
    "one scan at a pitch 3 deg off": (
        both(of_one("face", "pitch", lambda p: p + 0.05), of_one("beam", "pitch", lambda p: p + 0.05)), (),
    ),
    "cameras exchanged": (changed(view_camera=lambda c: 1 - c), ("far from stated",)),
    "noise of ranges stated a tenth": (changed(face_sigma=lambda s: s / 10), ("noise",)),
    "noise of images stated a tenth": (changed(view_covariance=lambda c: c / 100), ("noise",)),
    "focal length of one camera 3 % too long": (longer_lens, ("misfit", "noise")),
    "camera knocked aside half-way": (knocked, ("excluded", "misfit", "model error", "noise")),
    "pitch of scan lines 0.3 deg late": (late, ("lag",)),
    "pitch of scan lines 0.15 deg early": (lambda obs: late(obs, -0.0025), ("lag",)),
    # before a single background the edge bias takes it up
    "spot stated 2.5 times too wide": (changed(beam_radius=lambda r: 2.5 * r), ()),
    "spot stated 0.4 times too narrow": (changed(beam_radius=lambda r: 0.4 * r), ()),
    "three placements": (lambda obs: obs.select(obs.placements[:3]), ("placements",)),
    "one pitch only": (
        pitched(lambda p: 0.02 * p), ("pitch", "unobservable", "pitch scale", "far from stated")
    ),
}  # fmt: skip
