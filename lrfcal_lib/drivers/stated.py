"""What users state about devices: pydantic types with their ranges in words."""

from typing import Annotated, Any

from pydantic import BaseModel, StrictStr, model_validator

from lrfcal_lib.session.stated import refused


class Stated(BaseModel, frozen=True):
    """An object of a rig file: null is as good as left out, and keys that it does not have are refused."""

    @model_validator(mode="before")
    @classmethod
    def known(cls, data):
        """The values that are stated."""
        for key in data if isinstance(data, dict) else ():
            if key not in cls.model_fields:
                raise ValueError(f"{key} is not known; known are {', '.join(cls.model_fields)}")
        return {k: v for k, v in data.items() if v is not None} if isinstance(data, dict) else data


def number(least, most, unit="", kinds=(int, float), what="a number"):
    """A number within limits; NaN is in none, and true is no number."""
    words = f"{what} from {least} to {most} {unit}".rstrip() + " is needed"
    return Annotated[Any, refused(lambda value: type(value) not in kinds or not least <= value <= most, words)]


def whole(least, most):
    """A whole number within limits."""
    return number(least, most, kinds=(int,), what="a whole number")


def several(kind, count):
    """So many values of a kind."""
    return Annotated[tuple[kind, ...], refused(lambda values: len(values) != count, f"a list of {count} is needed")]


Text = Annotated[StrictStr, refused(lambda text: not text.isprintable() or not text, "a text is needed")]
Angle = number(-180, 180, "deg")
