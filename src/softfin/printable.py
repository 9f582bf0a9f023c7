"""Text that came out of files, made safe to show: a fin's name or a column's may hold what steers a terminal."""


def printable(text: str, keep: str = "") -> str:
    """One line of `text` with all that is not to be printed as escapes, such as ``\\x1b``; `keep` stays as it is.

    Control characters, marks that turn the direction of writing, and halves of surrogate pairs are not to be printed.
    """
    # Most texts need no copy.
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() or letter in keep else letter.encode("unicode_escape").decode()
        for letter in text
    )
