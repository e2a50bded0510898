"""Checks the built documentation: links inside hold, and nothing is loaded from elsewhere.

`python .ci/check_site.py site` reads every page of a folder, follows each link to its file and its anchor,
and refuses pictures, scripts, styles, fonts and frames from other hosts.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Links(HTMLParser):
    """The anchors of a page, what it links to, and what it loads."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = set()
        self.leads: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.leads.append(given["href"])
        elif "src" in given:
            self.loads.append(given["src"])
        elif tag == "link" and given.get("rel") != "canonical" and "href" in given:
            self.loads.append(given["href"])


def faults(site: Path) -> list[str]:
    """What is wrong with the site, one line each."""
    pages = {path.resolve(): Links(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, links in pages.items():
        name = path.relative_to(site.resolve())
        if name.name == "404.html":
            continue  # its links are absolute, since it may be shown anywhere
        for url in links.loads:
            parts = urlsplit(url)
            if parts.netloc or parts.scheme not in ("", "data"):
                found.append(f"{name}: loads {url}")
        for url in links.leads + links.loads:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                found.append(f"{name}: {url} leads nowhere")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{name}: {url} has no such anchor")
    for style in sorted(site.rglob("*.css")):
        elsewhere = re.findall(r"url\(['\"]?(?:https?:)?//[^)]*\)", style.read_text(encoding="utf-8"))
        found += [f"{style.relative_to(site)}: loads {url}" for url in elsewhere]
    return found


if __name__ == "__main__":
    site = Path(sys.argv[1])
    wrong = faults(site)
    print("\n".join(wrong) or f"{len(list(site.rglob('*.html')))} pages: all links inside hold")
    sys.exit(bool(wrong))
