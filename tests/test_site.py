"""The check of the built site finds what leads nowhere and what is fetched from elsewhere."""

from typing import Any, cast

import pytest

pytest.importorskip("bs4", reason="pip install -e '.[docs]'")

from bs4 import BeautifulSoup  # pyright: ignore[reportMissingImports]

from check_site import problems
from site_directives import fold, shorten

PAGE = '<html><head>{head}</head><body><h1 id="top">Title</h1>{body}</body></html>'


def site(folder, head="", body=""):
    (folder / "other.html").write_text(PAGE.format(head="", body='<p id="there">text</p>'))
    (folder / "index.html").write_text(PAGE.format(head=head, body=body))
    return problems(folder)


@pytest.mark.parametrize(
    "body",
    [
        '<a href="other.html#there">a</a> <a href="#top">b</a> <a href="other.html">c</a>',
        '<a href="https://example.org/page#part">a link that a person may follow</a>',
        '<a href="mailto:somebody@example.org">mail</a>',
    ],
)
def test_links_that_lead_somewhere_are_fine(tmp_path, body):
    assert site(tmp_path, body=body) == []


@pytest.mark.parametrize(
    ("head", "body", "problem"),
    [
        ("", '<a href="missing.html">a</a>', "index.html: no such file: missing.html"),
        ("", '<a href="other.html#gone">a</a>', "index.html: no such anchor: other.html#gone"),
        ("", '<a href="#gone">a</a>', "index.html: no such anchor: #gone"),
        ("", '<img src="gone.png">', "index.html: no such file: gone.png"),
        ('<script src="https://cdn.example/a.js"></script>', "", "fetches https://cdn.example"),
        ('<link rel="stylesheet" href="//fonts.example/a.css">', "", "fetches //fonts.example"),
    ],
)
def test_what_leads_nowhere_or_is_fetched_is_told(tmp_path, head, body, problem):
    (found,) = site(tmp_path, head, body)
    assert problem in found


def test_code_without_a_copy_button_is_told(tmp_path):
    code = '<div class="highlight"><pre>x = 1</pre></div>'
    assert site(tmp_path, body=code) == ["index.html: code without a button that copies it"]
    (tmp_path / "copybutton.js").touch()
    assert site(tmp_path, '<script src="copybutton.js?v=1"></script>', code) == []


def test_a_page_without_a_mode_is_told(tmp_path):
    (tmp_path / "bare.html").write_text('<html data-default-mode=""><body></body></html>')
    assert site(tmp_path) == ["bare.html: no default mode, which browsers report as an error"]


def test_long_pages_and_references_are_folded():
    """Anchors move into what is folded, so that links to them open it."""
    long = "<h1>Page</h1>" + "".join(
        f'<section id="s{k}"><h3>Part {k}</h3><p>{"word " * 4000}</p></section>' for k in range(2)
    )
    entry = (
        '<dl class="py class"><dt id="room.Thing">class Thing</dt><dd><p>A thing. More.</p>'
        '<dl class="py method"><dt id="room.Thing.act">act()</dt><dd><p>Act.</p></dd></dl>'
        "</dd></dl>"
        "<p>Used in: start.</p><p>After</p>"
    )

    def folded(page, body):
        context = {"body": body}
        fold(cast(Any, None), page, "", context, None)
        return BeautifulSoup(context["body"], "html.parser")

    page = folded("results", long)
    assert [s.get_text() for s in page.select("details > summary > h3")] == ["Part 0", "Part 1"]
    assert [d["id"] for d in page.select("section > details > div")] == ["s0", "s1"]
    assert not folded("results", long.replace("word ", "")).select("details")
    (details,) = folded("api/room", entry).select("details")
    assert details.select("summary")[0].get_text() == "Thing A thing"
    assert details.select_one("#room\\.Thing\\.act") is not None
    assert "Used in" in details.get_text()
    assert "After" not in details.get_text()


def test_styles_that_fetch_are_told(tmp_path):
    (tmp_path / "style.css").write_text("@import url('https://fonts.example/a.css');")
    assert site(tmp_path) == ["style.css: fetches from elsewhere"]


def test_numbers_of_default_tensors_are_left_out_of_signatures():
    default = "(a: float = 1.0, b: Tensor = tensor([[0., 1.],\n        [1., 0.]], dtype=float64))"
    app = cast(Any, None)
    short, returns = shorten(app, "class", "Thing", None, None, default, "int")
    assert (short, returns) == ("(a: float = 1.0, b: Tensor = tensor(...))", "int")
    assert shorten(app, "class", "Thing", None, None, None, None) == (None, None)
