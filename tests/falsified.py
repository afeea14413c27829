"""Ways to falsify what a session records or states, at the level of observations, with the cause to be named."""

from dataclasses import replace

import numpy as np

from lrfcal_lib.judge.alternatives import ALTERNATIVES


def scaled(**sizes):
    """Statements that are wrong by factors, or sizes, of ALTERNATIVES."""

    def change(obs):
        for kind, value in sizes.items():
            obs = ALTERNATIVES[kind].change(obs, value)
        return obs

    return change


def changed(where=lambda obs, group: slice(None), **new):
    """Fields that become a function of themselves, in the rows ``where(obs, group)`` of their group."""

    def change(obs):
        out = {name: getattr(obs, name).copy() for name in new}
        for name, function in new.items():
            rows = where(obs, name.split("_")[0])
            out[name][rows] = function(out[name][rows])
        return replace(obs, **out)

    return change


def pitched(function):
    """All recorded pitch angles."""
    return changed(
        face_pitch=function, beam_pitch=function, view_pitch=function, middle=function
    )


def of_one(obs, group, placement=2):
    """Rows of one placement's scans or images."""
    return getattr(obs, f"{group}_placement") == placement


def second_camera(obs, group):
    return obs.view_camera == 1


def first_camera_later(obs, group):
    return (obs.view_camera == 0) & (obs.view_placement >= len(obs.placements) // 2)


def exchanged(values, a=1, b=3):
    """Two numbers exchanged."""
    return np.select([values == a, values == b], [b, a], values)


def moved(by):
    """Board poses put elsewhere, metres."""
    return lambda pose: pose + np.pad(np.reshape(by, (3, 1)), ((0, 1), (3, 0)))


def mirrored(bearing):
    return np.pi - bearing


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
    "bearings mirrored": (changed(face_bearing=mirrored, beam_bearing=mirrored), ("far from stated",)),
    "pitch reversed": (pitched(np.negative), ("far from stated",)),
    "pitch 3 % too small": (pitched(lambda p: 0.97 * p), ("pitch scale",)),
    "pitch in grads instead of degrees": (pitched(lambda p: p / 0.9), ("pitch scale",)),
    "images of two placements exchanged": (changed(view_placement=exchanged), ("excluded",)),
    "scans of two placements exchanged": (
        changed(face_placement=exchanged, beam_placement=exchanged), ("excluded",)
    ),
    "board moved between scan and images": (changed(of_one, view_pose=moved([0, 0, 0.15])), ("excluded", "misfit")),
    "board leant over between scan and images": (
        changed(of_one, face_range=lambda r: r + np.linspace(0, 0.1, len(r))), ("excluded", "misfit")
    ),
    "one scan at a pitch 3 deg off": (
        changed(of_one, face_pitch=lambda p: p + 0.05, beam_pitch=lambda p: p + 0.05), (),
    ),
    "cameras exchanged": (changed(view_camera=lambda c: 1 - c), ("far from stated",)),
    "noise of ranges stated a tenth": (changed(face_sigma=lambda s: s / 10), ("noise",)),
    "noise of images stated a tenth": (changed(view_covariance=lambda c: c / 100), ("noise",)),
    "focal length of one camera 3 % too long": (
        changed(second_camera, view_pose=lambda T: T * [[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1.03], [1, 1, 1, 1]]),
        ("misfit", "noise"),
    ),
    "camera knocked aside half-way": (
        changed(first_camera_later, view_pose=moved([0.03, 0, 0])), ("excluded", "misfit", "model error", "noise")
    ),
    "pitch of scan lines 0.3 deg late": (scaled(lag=-0.005), ("lag",)),
    "pitch of scan lines 0.15 deg early": (scaled(lag=0.0025), ("lag",)),
    # before a single background the edge bias takes it up
    "spot stated 2.5 times too wide": (changed(beam_radius=lambda r: 2.5 * r), ()),
    "spot stated 0.4 times too narrow": (changed(beam_radius=lambda r: 0.4 * r), ()),
    "three placements": (lambda obs: obs.select(obs.placements[:3]), ("placements",)),
    "one pitch only": (
        pitched(lambda p: 0.02 * p), ("pitch", "unobservable", "pitch scale", "far from stated")
    ),
}  # fmt: skip
