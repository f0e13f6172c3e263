"""The report is one file that loads nothing."""

import re

from invertwin.cli.report import ReportPicture, ReportTable, report_html

PNG = b"\x89PNG\r\n\x1a\n"


def test_report_is_self_contained_and_escaped():
    text = report_html(
        "A < B",
        "converged",
        "first\n\nsecond",
        [
            ReportTable(
                "Poses", ["name", "x", "ok"], [["<letter>", 0.123456, True], ["wall", None, False]]
            ),
            ReportPicture("Loss & steps", PNG + b"data", note="one & two"),
        ],
        "reconstruct run.toml",
        {"run.toml": 'task = "demo"'},
    )
    assert "A &lt; B" in text
    assert "&lt;letter&gt;" in text
    assert "0.1235" in text
    assert re.findall(r'(?:src|href)="(?!data:)', text) == []
    assert "data:image/png;base64,iVBOR" in text
    assert "<script" not in text
    assert "<p>first</p>\n<p>second</p>" in text
    assert "<pre>invertwin reconstruct run.toml -o again</pre>" in text
    assert "<title>A &lt; B</title>" in text
    assert '<p class="status">converged</p>' in text
    assert "<tr><td>&lt;letter&gt;</td><td>0.1235</td><td>yes</td></tr>" in text
    assert "<tr><td>wall</td><td>–</td><td>no</td></tr>" in text
    assert "<p>one &amp; two</p>" in text
    assert "<summary>run.toml</summary>\n<pre>task = &#34;demo&#34;</pre>" in text
    assert "{{" not in text
    assert "{%" not in text
