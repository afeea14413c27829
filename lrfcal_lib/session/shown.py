"""Texts that may be somebody else's, as a terminal or a page may show them."""

import html
import re


def escape(text: object) -> str:
    """Anything as HTML that shows it as text: no tags, entities, or formulas.

    MathJax finds no pair of signs. All that becomes HTML comes through here, see also the report's
    template: names in a session may be somebody else's.

    Parameters
    ----------
    text
    """
    return re.sub(r"[$\\]", r"<span>\g<0></span>", html.escape(str(text)))


def printable(text: str) -> str:
    """Text as a terminal may show it: what steers it, or cannot be encoded, stands in letters.

    Parameters
    ----------
    text
    """
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)
