"""A city by tiles is the city as a whole, bit for bit whoever computes it."""

import json
import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT


@pytest.fixture
def small(city):
    """Sixteen tiles; a path is shorter than the city is wide."""
    return city.City(extent=480.0, lots=8, masts=2, reach=200.0, cells=32, tile=8)


@pytest.fixture
def here(city, monkeypatch):
    """Tiles are computed in this process; the fixture lists them."""
    numbers = []

    def done_here(work, jobs, **_):
        for place, job in enumerate(jobs):
            numbers.append(job[1])
            yield place, work(job)

    monkeypatch.setattr(city, "run_jobs", done_here)
    return numbers


@pytest.fixture
def one(city, small, here, tmp_path):
    """The whole map."""
    found = city.complete_map(small, tmp_path / "one")
    assert here == list(range(16))
    here.clear()
    return found


def test_buildings_stay_on_their_lots_and_masts_above_roofs(city):
    drawn = city.City()
    buildings, pitch = drawn.buildings(), drawn.extent / drawn.lots
    corners = buildings.mesh().vertices.numpy().reshape(-1, 8, 3)
    assert (np.abs(corners[..., :2] - buildings.center[:, None]) < pitch / 2).all()
    assert len(buildings.yaw) >= 2000
    assert np.ptp(corners[..., 2], axis=1) == pytest.approx(buildings.height + 1.0)
    transmitters = drawn.transmitters(buildings)
    assert len(transmitters) == 36
    for x, y, z in transmitters:
        below = (buildings.center == (x, y)).all(1)
        assert buildings.height[below] == pytest.approx([z - 5.0])


def test_walls_and_roofs_close_a_box_but_for_its_bottom(city):
    mesh = city.City(lots=10).buildings().mesh()
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].view(-1, 2).sort(dim=1).values
    _, counts = edges.unique(dim=0, return_counts=True)
    boxes = len(mesh.vertices) // 8
    assert counts.bincount().tolist() == [0, 4 * boxes, 13 * boxes]  # edges of the bottom are open


def test_gain_of_a_path_by_friis_and_none_beyond_the_reach(city):
    nobody = city.City().buildings().select(np.zeros(len(city.City().buildings().yaw), bool))
    tx, points = np.array([[0.0, 0.0, 40.0]]), torch.tensor([[100.0, 0.0, 1.5], [0.0, 200.0, 1.5]])
    ground = np.array([[-300.0, -300.0], [300.0, 300.0]])

    def gains(reach):
        found = city.City(reach=reach).trace(nobody, tx, points.double(), ground)[0].tolist()
        wave = SPEED_OF_LIGHT / city.FREQUENCY
        friis = [(wave / (4 * math.pi * d)) ** 2 for d in np.hypot([100.0, 200.0], 38.5)]
        return [gain / free for gain, free in zip(found, friis, strict=True)]

    # The straight paths are 107.2 m and 203.7 m long, those by way of the ground 108.3 and 204.3.
    assert gains(107.0) == [0.0, 0.0]
    assert gains(108.0) == pytest.approx([1.0, 0.0], rel=1e-9)
    assert gains(204.0)[1] == pytest.approx(1.0, rel=1e-9)
    reflected = []
    for across in (100.0, 200.0):  # the first is near Brewster's angle
        slope = 41.5 / np.hypot(across, 41.5)
        root = math.sqrt(5.24 - 1 + slope**2)
        fresnel = (5.24 * slope - root) / (5.24 * slope + root)
        reflected.append((fresnel * np.hypot(across, 38.5) / np.hypot(across, 41.5)) ** 2)
    assert reflected[0] < 0.001 < 0.05 < reflected[1]
    assert gains(600.0) == pytest.approx([1 + part for part in reflected], rel=1e-6)


def test_tiles_are_the_whole_city(city, small, one, tmp_path):
    merged, whole = one.merge(), city.trace_untiled(small)
    gains = np.load(one.folder / "map.npy")
    assert merged == (one.folder / "map.npy").read_bytes()
    for number in range(16):
        column, row = (8 * part for part in divmod(number, 4))
        tile = gains[:, column : column + 8, row : row + 8]
        assert tile == pytest.approx(whole[:, number], rel=1e-9, abs=0)
    assert 0.2 < (gains[0] > 0).mean() < 0.9
    assert (gains[1] > 1.001 * gains[0]).any()  # several transmitters reach a cell
    # Tiles lack buildings, and the halo has those that matter.
    everything = 64 * len(small.buildings().yaw)
    assert all(cost["pairs"] < cost["links"] * everything for cost in one.costs)
    compared = city.compare_untiled(small, tmp_path / "one")
    assert compared == {"difference": pytest.approx(0, abs=1e-9), "unequal_cells": 0}


def test_a_halo_of_a_third_makes_another_map(city, small, one, monkeypatch):
    """The comparison sees what it is for: buildings outside of the tile."""
    whole = city.Buildings.distances
    monkeypatch.setattr(city.Buildings, "distances", lambda *given: 3 * whole(*given))
    gains, _ = city.map_tile((small, 4))
    assert not np.allclose(gains, np.load(one.tile_file(4)), rtol=0.01, atol=0)


def test_two_workers_make_the_same_bytes(city, small, tmp_path):
    one, two = (city.complete_map(small, tmp_path / str(n), workers=n) for n in (1, 2))
    assert two.merge() == one.merge()


def test_maps_of_two_cities_do_not_mix(city, small, one, tmp_path):
    other = city.complete_map(replace(small, seed=2), tmp_path / "one")
    assert other.folder != one.folder
    assert other.merge() != one.merge()


def test_only_missing_tiles_are_computed_again(one, here):
    merged, wall = one.merge(), one.wall_seconds
    assert list(one.compute()) == []
    assert one.wall_seconds == wall > 0
    for number in (2, 7):
        one.tile_file(number).unlink()
    steps = one.compute()
    assert next(steps) == 2
    steps.close()  # an interruption
    assert list(one.compute()) == [7]
    assert here == [2, 7]
    assert one.merge() == merged
    assert one.wall_seconds is None  # of an interrupted run there is no time


def test_model_of_known_costs(city):
    rows = [{"links": n, "pairs": n**2, "seconds": 0.5 * n + 0.01 * n**2} for n in range(1, 5)]
    twice = [row | {"seconds": 2 * row["seconds"]} for row in rows]
    fitted = city.fit_model(rows, twice)
    assert fitted == pytest.approx({"link": 0.5, "pair": 0.01, "error": -0.5})


@pytest.mark.slow
def test_table_has_what_must_hold(city, small, here, tmp_path, monkeypatch):
    """All metrics but those of Ray, of a city that is too small."""
    monkeypatch.setattr(city, "find_spec", lambda _: None)
    monkeypatch.setattr(city, "DENSER", (4, 8))
    metrics = city.measure(small, small, tmp_path)
    assert metrics["bytes_equal"] == {"workers_2": True, "workers_4": True}
    grown = metrics["growth"]
    assert grown["cells"] == [64, 256, 1024]
    assert grown["buildings"][1] == metrics["buildings"] > 3 * grown["buildings"][0]
    assert grown["n_log_n"] > 1.1
    grid = city.table(metrics).grid
    cells = dict(zip(grid.columns[0].cells, grid.columns[2].cells, strict=True))
    assert cells["buildings"] == ">= 2e+03 NO"
    assert cells["difference"] == "<= 1e-06 yes"
    assert cells["bytes_equal.workers_4"] == ">= 1 yes"
    assert cells["cells_exponent"].startswith("<= 1.1 ")
    city.write(metrics, grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics


@pytest.mark.slow
def test_a_killed_node_changes_no_byte(city, small, tmp_path, monkeypatch):
    """Runs where the extra `ray` is installed."""
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # of the nodes
    one = city.complete_map(small, tmp_path / "one")
    killed, seconds = city.map_beside_kill(small, tmp_path / "killed")
    assert killed.merge() == one.merge()
    assert seconds > 0
    again, same = city.map_beside_kill(small, tmp_path / "killed")
    assert (again.merge(), same) == (one.merge(), seconds)
