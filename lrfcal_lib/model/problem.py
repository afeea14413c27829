"""What of a recording cannot be used, and why."""

from dataclasses import dataclass
from enum import Enum, auto


class Stage(Enum):
    """Where something turned out to be of no use."""

    SCANS = auto()
    IMAGES = auto()
    SIDES = auto()  # scans and images beside each other: planes, names of sides
    PLATFORM = auto()  # the tilt axis by itself
    CAMERAS = auto()  # one by one
    JOINT = auto()  # everything at once
    STATIONS = auto()  # of a scene, beside each other


class ProblemKind(Enum):
    """What cannot be used."""

    NO_BOARD = auto()  # the scan of a placement shows none
    OTHER_PLANE = auto()  # scan and images of a placement contradict each other
    OTHER_SIDE = auto()  # a side of a scan lies elsewhere than the board's edge
    NO_POSE = auto()  # of a camera, from the planes
    NO_IMAGES = auto()
    NO_OUTLINE = auto()  # the images do not show where the board ends
    SMALL_SQUARES = auto()  # of the pattern, in images of a camera
    NO_RESULT = auto()  # by a method
    TOO_LITTLE = auto()  # neither images nor edges enough for the pose of a board
    CONTRADICTS = auto()  # placement, image or pair of stations: all others
    NO_OVERLAP = auto()  # of two stations
    LEFT_OUT = auto()  # a station that no other one joins
    AMBIGUOUS = auto()  # two stations fit together in more than one way


LEAVES_OUT = {ProblemKind.NO_BOARD, ProblemKind.OTHER_PLANE}  # the whole placement


@dataclass(frozen=True)
class Problem:
    """Something that cannot be used.

    Attributes
    ----------
    stage : Stage
    kind : ProblemKind
    words : str
        Why, for the user; without the placement.
    placement : int or None
    camera : str or None
    method : str or None
        That gives no result.
    """

    stage: Stage
    kind: ProblemKind
    words: str
    placement: int | None = None
    camera: str | None = None
    method: str | None = None

    def __str__(self) -> str:
        """One sentence, with what it is about: the placement, or else the camera and the method."""
        if self.placement is not None:
            return f"placement {self.placement}: {self.words}"
        about = []
        name = f"camera '{self.camera}'"
        if self.camera is not None and name not in self.words:
            about.append(name)
        if self.method is not None:
            about.append(f"method '{self.method}'")
        return ": ".join([*about, self.words])
