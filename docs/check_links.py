"""Check that each link of the built site leads somewhere, and that no page fetches anything from elsewhere.

    python docs/check_links.py FOLDER

Exit status 1 and a line for each that does not. Addresses on other machines are counted, not visited.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

FETCHED = {"img": "src", "script": "src", "link": "href", "iframe": "src", "source": "src"}


class Page(HTMLParser):
    """Links, what the page fetches, and anchors of an HTML file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep what a tag links to, fetches and names."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag in FETCHED and FETCHED[tag] in values and values.get("rel") != "canonical":
            self.fetched.append(values[FETCHED[tag]])


def problems_of(folder: Path) -> tuple[list[str], int, int]:
    """What is wrong, and how many links lead within the site and elsewhere."""
    pages = {path.resolve(): Page(path) for path in folder.rglob("*.html")}
    wrong, inside, outside = list[str](), 0, 0
    for path, page in pages.items():
        for link in [*page.links, *page.fetched]:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "mailto"):
                outside += 1
                wrong += [f"{path.name}: fetches {link}"] if link in page.fetched else []
                continue
            inside += 1
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                wrong.append(f"{path.name}: {link} is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                wrong.append(f"{path.name}: {link}: the page has no such place")
    return wrong, inside, outside


if __name__ == "__main__":
    found, inner, outer = problems_of(Path(sys.argv[1]))
    for line in found:
        print(line)
    print(f"{len(found)} broken links of {inner} within the site; {outer} lead elsewhere")
    sys.exit(bool(found) or not inner)
