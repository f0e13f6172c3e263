"""The report is one file that loads nothing, and its pictures are pictures."""

import re

import numpy as np

from invertwin.cli import pictures
from invertwin.cli.report import Again, Picture, Table, report_html

PNG = b"\x89PNG\r\n\x1a\n"
BOX = (
    np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (2.0, 3)]),
    np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ]
    ),
)


def test_report_is_self_contained_and_escaped():
    text = report_html(
        "A < B",
        "converged",
        "first\n\nsecond",
        [
            Table(
                "Poses", ["name", "x", "ok"], [["<letter>", 0.123456, True], ["wall", None, False]]
            ),
            Picture("Loss & steps", PNG + b"data", note="one & two"),
        ],
        Again("reconstruct run.toml", {"run.toml": 'task = "demo"'}),
    )
    assert "A &lt; B" in text
    assert "&lt;letter&gt;" in text
    assert "0.1235" in text
    assert re.findall(r'(?:src|href)="(?!data:)', text) == []
    assert "data:image/png;base64,iVBOR" in text
    assert "<script" not in text
    assert "<p>first</p>\n<p>second</p>" in text
    assert "invertwin reconstruct run.toml -o again" in text


def test_scene_picture_draws_open_closed_and_empty_scenes():
    drawing = pictures.Drawing(
        {"box": BOX, "plate": (BOX[0][:3], np.array([[0, 1, 2]]))},
        sought=["box"],
        outline={"box": BOX},
        radar=np.zeros((1, 3)),
    )
    assert pictures.scene_picture({"truth": drawing, "nothing": pictures.Drawing({})})[:8] == PNG


def test_only_edges_that_bend_are_outlined():
    assert len(pictures._sharp_edges(*BOX)) == 12


def test_splitting_keeps_the_area():
    triangles = BOX[0][BOX[1]]
    small = pictures._small_triangles(triangles, 0.3)

    def area(t):
        return np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2

    assert len(small) > len(triangles)
    assert np.isclose(area(small), area(triangles))


def test_spectra_of_every_layout_and_of_silence():
    rng = np.random.default_rng(0)
    for u, v in ((8, 4), (8, 1), (1, 1)):
        axes = pictures.Axes(np.linspace(1, 2, 6), np.linspace(-1, 1, u), np.linspace(-1, 1, v))
        power = rng.random((3, 6, u, v))
        png = pictures.spectra_picture({"measured": power, "start": np.zeros_like(power)}, axes)
        assert png[:8] == PNG
        maps = {"differences": power, "full": 0 * power}
        png = pictures.gradient_picture(maps, ("full − differences", power), axes, "1/m")
        assert png[:8] == PNG


def test_curves():
    x = np.linspace(-1, 1, 9)
    losses = {"full": [[1.0, 0.5], [0.0, 0.0]], "interior": [[1.0, 0.01]]}
    assert pictures.loss_picture(losses, annealed=1.0, before=0.7)[:8] == PNG
    assert pictures.loss_picture({})[:8] == PNG
    assert pictures.landscape_picture((x, x**2), {"wide": (x, x**2)}, "plate along z")[:8] == PNG


def test_pictures_repeat_byte_for_byte():
    assert pictures.loss_picture({"a": [[1.0]]}) == pictures.loss_picture({"a": [[1.0]]})
