"""Check the built site without a network: links, what pages fetch, buttons that copy code.

Usage: python docs/check_site.py out/docs/html

What needs a browser is in tests/browser/test_site.py.
"""

import re
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

from bs4 import BeautifulSoup  # pyright: ignore[reportMissingImports]

# What a browser fetches without being asked; a link of a person's choice is none of these.
FETCHED = {"img": "src", "script": "src", "link": "href", "iframe": "src", "source": "src"}
ELSEWHERE = re.compile(r"^(?:https?:)?//")
IN_STYLE = re.compile(r"""(?:url\(|@import)\s*['"]?(?:https?:)?//""")


def problems(site: Path) -> list[str]:
    """One line for each link that leads nowhere, and for each thing fetched from elsewhere."""
    pages = {
        file: BeautifulSoup(file.read_text(encoding="utf-8"), "html.parser")
        for file in sorted(site.rglob("*.html"))
        if "_static" not in file.parts  # parts of the theme, not pages
    }
    anchors = {
        file: {str(tag["id"]) for tag in page.find_all(id=True)} for file, page in pages.items()
    }
    found = []
    for file, page in pages.items():
        name = file.relative_to(site)
        if page.select("div.highlight pre") and not page.select("script[src*='copybutton.js']"):
            found.append(f"{name}: code without a button that copies it")
        if page.html is not None and page.html.get("data-default-mode") == "":
            found.append(f"{name}: no default mode, which browsers report as an error")
        for tag in page.find_all(list(FETCHED)):
            address = str(tag.get(FETCHED[tag.name]) or "")
            if ELSEWHERE.match(address) and "canonical" not in (tag.get("rel") or []):
                found.append(f"{name}: fetches {address}")
        for tag in page.find_all(["a", *FETCHED]):
            link = urlsplit(str(tag.get(FETCHED.get(tag.name, "href")) or ""))
            if link.scheme or link.netloc:
                continue
            target = (file.parent / unquote(link.path)).resolve() if link.path else file
            if not target.exists():
                found.append(f"{name}: no such file: {link.path}")
            elif link.fragment and target in anchors:
                wanted = unquote(link.fragment)
                if wanted not in anchors[target]:
                    found.append(f"{name}: no such anchor: {link.geturl()}")
    for file in sorted(site.rglob("*.css")):
        if IN_STYLE.search(file.read_text(encoding="utf-8")):
            found.append(f"{file.relative_to(site)}: fetches from elsewhere")
    return found


if __name__ == "__main__":
    found = problems(Path(sys.argv[1]).resolve())
    print(
        "\n".join(found) or "links and anchors lead somewhere; nothing is fetched; code is copied"
    )
    sys.exit(bool(found))
