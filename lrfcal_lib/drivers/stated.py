"""What users state about devices: kinds of values with their ranges, one message for whatever is not of its kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields


@dataclass(frozen=True)
class Kind:
    """What a value must be: in words, and as a test that takes anything JSON can hold."""

    words: str
    fits: Callable


def number(least, most, unit=""):
    """A number within limits; NaN is in none."""
    words = f"a number from {least:g} to {most:g} {unit}".rstrip()
    return Kind(words, lambda v: isinstance(v, int | float) and not isinstance(v, bool) and least <= v <= most)


def whole(least, most):
    """A whole number within limits."""
    words = f"a whole number from {least} to {most}"
    return Kind(words, lambda v: isinstance(v, int) and not isinstance(v, bool) and least <= v <= most)


def one_of(*choices):
    """One of some texts, numbers, true and false; 1 is not true."""
    words = " or ".join(repr(c) if isinstance(c, str) else str(c).lower() for c in choices)
    return Kind(words, lambda v: any(type(v) is type(c) and v == c for c in choices))


def either(*kinds):
    """A value of one of some kinds."""
    return Kind(", or ".join(kind.words for kind in kinds), lambda v: any(kind.fits(v) for kind in kinds))


def listed(kind, count=None):
    """A list of values of a kind."""
    words = f"a list of {count or 'any number'}, each {kind.words}"
    return Kind(words, lambda v: isinstance(v, list | tuple) and len(v) == (count or len(v)) and all(map(kind.fits, v)))


TEXT = Kind("a text", lambda v: isinstance(v, str) and v.isprintable() and v != "")
FLAG = one_of(True, False)
OBJECT = Kind("an object with keys", lambda v: isinstance(v, dict))


def stated(kind, default):
    """A field of a dataclass, for values of a kind."""
    return field(default=default, metadata={"kind": kind})


def kinds(cls):
    """Kinds of the fields of a dataclass, by name."""
    return {one.name: one.metadata["kind"] for one in fields(cls)}


def check(values, kinds, where, needed=()):
    """The values that are stated: null is as good as left out.

    Parameters
    ----------
    values : dict
    kinds : dict of str to Kind
    where : str
        Path of the object, for messages.
    needed : sequence of str
        Keys that must be stated.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        For no object, an unknown or missing key, or a value of another kind.
    """
    need(OBJECT, values, where)
    for key, value in values.items():
        if key not in kinds:
            raise ValueError(f"{where}.{key} is not known; known are {', '.join(kinds)}")
        if value is not None:
            need(kinds[key], value, f"{where}.{key}")
    for key in needed:
        if values.get(key) is None:
            raise ValueError(f"{where}.{key} is missing")
    return {key: value for key, value in values.items() if value is not None}


def need(kind, value, where):
    """A ValueError names a value that is not of its kind, and where it stands."""
    if not kind.fits(value):
        text = ascii(value)
        raise ValueError(f"{where} is {text if len(text) < 100 else text[:80] + ' ...'}: {kind.words} is needed")
