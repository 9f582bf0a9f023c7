"""Text that came out of files and devices, made safe to show: a fin's name may hold what steers a
terminal."""


def printable(text: str, keep: str = "", most: int | None = None) -> str:
    r"""`text` with all that cannot be printed as escapes such as ``\x1b``, and cut where it is
    longer than `most`.

    Escaped are control characters, marks that turn the direction of writing, halves of surrogate
    pairs, and ends of lines unless `keep` holds them.
    """
    shown = "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode()
        for letter in text[:most]
    )
    return shown if most is None or max(len(text), len(shown)) <= most else shown[: most - 2] + " …"
