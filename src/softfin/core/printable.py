"""Makes text from files and devices safe to display; the name of a fin, for example, may contain
terminal control sequences."""


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
