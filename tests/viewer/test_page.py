"""Pages with a display: they stand alone, and what names hold does not act."""

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.channel import Grid
from invertwin.viewer import (
    Display,
    DisplayLayer,
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    content_security_policy,
    page_html,
    view_html,
)

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def display() -> Display:
    grid = Grid(1.0, 0.1, 4, -0.5, 0.25, 5)
    power = torch.full((1, 4, 5, 1), 1e-9)
    power[0, 2, 3], power[0, 0, 1] = 1.0, 0.01
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    steps = [
        DisplayStep(k, f"{EVIL} {k}", {EVIL: DisplayMesh(points + k, faces)}) for k in range(5)
    ]
    return Display(
        EVIL,
        [DisplayLayer(f"twin/{EVIL}", "surface", points, faces)],
        steps,
        maps={EVIL: DisplayMaps.from_spectra({"measured": power}, grid)},
    )


def test_names_do_not_act():
    page = page_html(display())
    assert "<img" not in page
    assert "<script>alert" not in page
    assert len(re.findall(r"<script\b", page)) == 2  # the data, and ours
    found = re.search(r'id="view-data">(.*?)</script>', page, re.S)
    assert found is not None
    assert json.loads(found[1])["layers"][0]["name"] == f"twin/{EVIL}"


def test_the_policy_admits_our_script_alone():
    page = page_html(display())
    script = re.findall(r"<script>(.*?)</script>", page, re.S)[-1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in content_security_policy()
    assert content_security_policy() in page
    assert "default-src 'none'" in page
    assert "http://" not in page
    assert "https://" not in page


def test_steps_hold_numbers_as_they_are_and_triangles_where_they_change():
    found = re.search(r'id="view-data">(.*?)</script>', view_html(display()), re.S)
    assert found is not None
    data = json.loads(found[1])
    body = data["steps"][3]["bodies"][f"twin/{EVIL}"]
    points = np.frombuffer(base64.b64decode(body["points"]), "<f4").reshape(-1, 3)
    assert points.tolist() == [[3, 3, 3], [4, 3, 3], [3, 4, 3]]
    assert "faces" not in body
    assert [step["label"][-1] for step in data["steps"]] == ["0", "1", "2", "3", "4"]


def test_maps_are_bytes_of_decibels_below_the_peak():
    found = re.search(r'id="view-data">(.*?)</script>', view_html(display()), re.S)
    assert found is not None
    (sensor,) = json.loads(found[1])["sensors"]
    assert sensor["name"] == EVIL
    assert sensor["simulated"] is None
    levels = np.frombuffer(base64.b64decode(sensor["measured"]), np.uint8).reshape(sensor["shape"])
    assert levels[2, 3] == 255
    assert levels[0, 1] == pytest.approx(127.5, abs=1)  # 20 of 40 dB
    assert np.count_nonzero(levels) == 2


def test_large_steps_are_thinned_out():
    made = display()
    points = np.random.default_rng(1).random((60_000, 3), np.float32)
    steps = [
        DisplayStep(k, str(k), {EVIL: DisplayMesh(points, made.layers[0].faces)}) for k in range(20)
    ]
    large = view_html(replace(made, steps=steps))
    labels = re.findall(r'"label": "(\d+)"', large)
    assert labels == ["0", "19"]
