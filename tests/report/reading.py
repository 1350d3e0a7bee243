"""A page as a browser reads it: what is open, in which order, where it leads, and what it says."""

import base64
import hashlib
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "br", "img", "hr", "link", "input"}
HOSTILE = '<script>alert(1)</script> "><img src=x onerror=alert(2)> $\\frac$ {{ 7*7 }} &amp; \x07'


@dataclass
class Read(HTMLParser):
    """What was read of a page."""

    open: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    words: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        if data.strip() and self.open[-1:] not in (["style"], ["script"]):
            self.words.append((self.open[-1] if self.open else "", " ".join(data.split())))

    @property
    def text(self) -> str:
        return " ".join(words for _, words in self.words)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.tags if name == tag]


def read_page(page: str | Path) -> Read:
    """Read a page, and check what holds for every page: it is whole, leads nowhere, runs nothing, has alt texts."""
    text = page.read_text("utf-8") if isinstance(page, Path) else page
    found = Read()
    found.feed(text)
    found.close()
    assert (found.open, found.wrong) == ([], []), "every tag is closed, in its order"
    names = [name for name, _ in found.tags]
    assert names.count("script") == ("script-src 'sha256-" in text), "no script, or our own, by its hash"
    assert not {"link", "iframe", "object", "base", "form"} & set(names)
    for _, attrs in found.tags:
        assert not any(key.startswith("on") for key in attrs), attrs
        for key in ("href", "xlink:href", "src", "action"):
            assert (attrs.get(key) or "#").startswith(("#", "data:image/png;base64,")), attrs
        assert set(re.findall(r"url\((.)", attrs.get("style") or "")) <= {"#"}, attrs
    styles = re.findall("<style>(.*?)</style>", text, re.DOTALL)
    assert len(styles) == 1
    assert "url(" not in styles[0]
    assert "@import" not in styles[0]
    assert "http" not in text.replace("http-equiv", ""), "no address of another page"
    for script in re.findall("<script>(.*?)</script>", text, re.DOTALL):
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"script-src 'sha256-{digest}'\"" in text
    for svg in found.named("svg"):
        assert svg["role"] == "img"
        assert len(svg["aria-label"] or "") > 20
    assert names.count("svg") == names.count("figcaption") == names.count("figure")
    ids = [attrs["id"] for _, attrs in found.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    uses = {target for _, attrs in found.tags if (target := attrs.get("href") or "").startswith("#")}
    assert uses <= {f"#{name}" for name in ids}
    assert names[names.index("main") + 1] == "h1"
    assert "verdict" in (found.tags[names.index("h1") + 1][1]["class"] or ""), "the verdict stands first"
    return found
