"""Text for display: safe, because the name of a fin from a file or device, for example, may contain
terminal control sequences, and with minus signs."""


def printable(text: str, keep: str = "", most: int | None = None) -> str:
    r"""Return `text` with unprintable characters escaped, for example as ``\x1b``, and cut to
    `most` characters.

    Control characters, direction marks, lone surrogates and line ends are escaped, unless `keep`
    contains them.
    """
    shown = "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode()
        for letter in text[:most]
    )
    return shown if most is None or max(len(text), len(shown)) <= most else shown[: most - 2] + " …"


def with_minus_signs(text: str) -> str:
    """Replace hyphens with minus signs in a text in which every hyphen is a minus sign."""
    return text.replace("-", "\N{MINUS SIGN}")
