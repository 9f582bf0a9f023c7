"""Extension of Sphinx: the sidebar, cells as one types them, links by a page's title, and an error
for a dead link."""

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

FILE = re.compile(r"(?:docs/)?[\w/-]+\.md")


class Page(HTMLParser):
    """The links of a page, and the places in it that links lead to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: set[str] = set()
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value and tag != "base":
                self.targets.add(value)


def dead_links(site: Path) -> list[str]:
    """List the links between the pages below a folder that lead nowhere, as `PAGE: LINK`."""
    pages = {file.resolve(): Page(file.read_text()) for file in site.rglob("*.html")}
    dead = []
    for file, page in pages.items():
        for target in page.targets:
            link = urlsplit(target)
            if link.scheme or link.netloc:
                continue
            place = (file.parent / unquote(link.path)).resolve() if link.path else file
            found = pages.get(place)
            # An anchor of a page with a script is for its script.
            named = not link.fragment or found is None or unquote(link.fragment) in found.anchors
            if not place.exists() or not named:
                dead.append(f"{file.relative_to(site.resolve())}: {target}")
    return sorted(dead)


EXPLORER = (
    '<iframe src="explorer.html" title="Explorer: drag the reference force and watch the fin"\n'
    '  style="width: 100%; height: 1360px; border: 1px solid var(--color-background-border)">'
    '</iframe>\n\nYou can also <a href="explorer.html">open it on its own page</a>.'
)


def complete_index(app: Any, docname: str, source: list[str]) -> None:
    """Put the explorer into the first page, and make the sidebar from its list of all pages."""
    if docname != "index":
        return
    text, _, lists = source[0].partition("## All pages\n")
    trees = [""]
    for group in re.split(r"^- \*\*", lists, flags=re.MULTILINE)[1:]:
        caption, _, rest = group.partition("**")
        names = re.findall(r"\]\(([^)]+)\.md\)", rest)
        trees += ["```{toctree}", ":hidden:", f":caption: {caption}", "", *names, "```", ""]
    source[0] = text.replace("<!-- explorer -->", EXPLORER) + "\n".join(trees)


def show_as_typed(app: Any, doctree: Any) -> None:
    """Show shell cells without ``%%sh``, and the file that ``%%writefile`` writes under its
    name."""
    from docutils import nodes

    for block in doctree.findall(nodes.literal_block):
        first, _, rest = block.astext().partition("\n")
        magic, *names = first.split() or [""]
        if magic == "%%sh":
            language = "sh"
            text = rest
        elif magic == "%%writefile":
            language = Path(names[0]).suffix.lstrip(".").replace("py", "python")
            text = f"# {names[0]}\n{rest}"
        else:
            continue
        block["language"] = language
        block.rawsource = text
        block.children[:] = [nodes.Text(text)]


def name_by_title(app: Any, doctree: Any, docname: str) -> None:
    """Show the title of a page where its file is the text of a link."""
    from docutils import nodes

    for link in doctree.findall(nodes.reference):
        if link.get("internal") and FILE.fullmatch(link.astext()):
            page = app.builder.env.relfn2path(link["refuri"].partition("#")[0], docname)[
                0
            ].removesuffix(".html")
            if (title := app.builder.env.titles.get(page)) is not None:
                link.clear()
                link += nodes.inline(text=title.astext())


def check(app: Any, failure: Exception | None) -> None:
    """Fail where a link is dead."""
    from sphinx.errors import SphinxError

    if failure is None and app.builder.format == "html" and (dead := dead_links(Path(app.outdir))):
        raise SphinxError("dead links:\n" + "\n".join(dead))


def setup(app: Any) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("source-read", complete_index)
    app.connect("doctree-read", show_as_typed)
    app.connect("doctree-resolved", name_by_title)
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
