"""`invertwin dataset`: many simulated samples of one run file, in shards."""

import hashlib
import json
import re
import time
import tomllib
import warnings
from contextlib import closing
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from invertwin import __version__, plotting
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import simulate_chirp_beats, simulate_exact, warn_if_aliased
from invertwin.cli.inputs import DATASET_SECTIONS
from invertwin.cli.report import ReportTable, quantity_table, save_picture, write_report
from invertwin.cli.run_file import load_run, to_toml, validate_run
from invertwin.cli.schema import RunFile, build, motion_tables
from invertwin.cli.schema.variation import draw_sample
from invertwin.datasets import SampleDataset, labels, shards
from invertwin.errors import InputError, PhysicsWarning, locate_errors
from invertwin.radar.processing import doppler
from invertwin.registry.section import require_section
from invertwin.runtime.engines import Engine, run_jobs
from invertwin.runtime.progress import track
from invertwin.scene import Scene
from invertwin.storage.folders import PARTS, UNFINISHED
from invertwin.storage.run_folder import RunFolder, open_run

_NUMERICAL_PACKAGES = ("drjit", "finufft", "mitsuba", "numpy", "torch")
# Names of arrays, by what the run file calls them.
_ARRAY_NAMES = {"raw": "beat", "map": "map", "micro_doppler": "micro_doppler"}
_FIELD_UNIT = "√(received over sent)"


def dataset(
    run_file: str | Path,
    folder: str | Path,
    *,
    workers: int = 1,
    engine: Engine = "processes",
    part: tuple[int, int] = (1, 1),
    seed: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
) -> SampleDataset:
    """Simulate a data set: samples of a run file with ``[dataset]`` and ``[[vary]]``.

    Sample i depends on the run file, the seed and i only. So any number of workers, parts and
    interruptions makes the same shards, bit for bit. Workers are spawned: a script that calls this
    does so below ``if __name__ == "__main__":``.

    Args:
        run_file: The run file (TOML).
        folder: Folder of the shards; each part has a folder of its own inside.
        workers: Processes of one thread each.
        engine: ``processes`` of this machine, or tasks of a ``ray`` cluster.
        part: Number from 1, and how many parts there are: part i of n makes every n-th shard.
        seed: Seed instead of the run file's.
        overwrite: Replace the results in the folder when this run ends.
        resume: Go on with the interrupted run in the folder.

    Returns:
        The samples that the folder holds, for a ``DataLoader``.

    Raises:
        InputError: A wrong run file, a folder with other files where shards go, or a sample that
            cannot be simulated.
    """
    file = Path(run_file)
    run = load_run(file)
    with locate_errors(file):
        for section in DATASET_SECTIONS:
            require_section(run, section, "dataset")
    run = run if seed is None else run.model_copy(update={"seed": seed})
    place = part_folder(Path(folder), part)
    with open_run(place, {"run": to_toml(run)}, overwrite=overwrite, resume=resume) as opened:
        if not opened.complete:
            with locate_errors(file):
                run_dataset(run, opened, part, engine, workers)
    return SampleDataset(place)


def part_folder(folder: Path, part: tuple[int, int]) -> Path:
    """Return the folder of a part of a data set.

    Args:
        folder: Folder of the whole data set.
        part: Number and count; a single part uses the folder itself.
    """
    return folder if part == (1, 1) else folder / f"part_{part[0]}_of_{part[1]}"


def parse_part(text: str | None) -> tuple[int, int]:
    """The part that `--shard i/n` names.

    Raises:
        InputError: The text is not of the form i/n.
    """
    if text is None:
        return 1, 1
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if found is None:
        raise InputError(f"expected --shard as i/n such as 2/5, got {text!r}; correct it")
    return int(found[1]), int(found[2])


def run_dataset(
    run: RunFile, folder: RunFolder, part: tuple[int, int], engine: Engine, workers: int
) -> tuple[list[ReportTable], str]:
    """Simulate the shards of a part that are not there yet; return tables and a sentence to print.

    Args:
        run: The run file of the data set.
        folder: Folder of the part.
        part: Number and count.
        engine, workers: Engine and number of its processes.

    Raises:
        InputError: A sample that cannot be simulated; the message names it.
    """
    table, begin = require_section(run, "dataset", "a data set"), time.perf_counter()
    wanted = shards.shard_ranges(table.samples, table.shard, part)
    # A sample is built before any work is done: its errors and its warnings come at once.
    own = make_sample_run(run, wanted[0][1])
    with locate_errors(f"sample {wanted[0][1]}"):
        scene, sensor = _build_sample(own)
        require_resources(own, scene, {"": sensor})
        if own.chirps is not None:
            moving, chirps = motion_tables.build_moving_scene(own, scene), own.chirps.build()
            warn_if_aliased(moving, sensor.radar, chirps)
    found = {number: _read_finished_shard(folder, number) for number, _, _ in wanted}
    missing = [row for row in wanted if found[row[0]] is None]
    text = to_toml(run)
    jobs = [(text, first, count) for _, first, count in missing]
    with closing(run_jobs(make_shard, jobs, engine=engine, workers=workers)) as done:
        for _ in track(missing, "shards"):
            at, content = next(done)
            number, first, count = missing[at]
            name = shards.shard_name(number)
            folder.write_bytes(name, content)
            found[number] = shards.describe_shard(name, first, count, content).model_dump()
            folder.write_json(_shard_row_path(number), found[number])
    rows = [shards.Shard.model_validate(found[number]) for number, _, _ in wanted]
    versions = {name: metadata.version(name) for name in _NUMERICAL_PACKAGES}
    content: Any = {"format": shards.FORMAT, "samples": table.samples, "part": part, "shards": rows}
    content["fingerprint"] = hashlib.sha256(text.encode()).hexdigest()
    content |= {"versions": {"invertwin": __version__, **versions}, "arrays": _describe_arrays(run)}
    manifest = shards.DatasetManifest(**content)
    folder.write_text(shards.MANIFEST, manifest.model_dump_json(indent=1) + "\n")
    count, seconds = sum(shard.samples for shard in rows), time.perf_counter() - begin
    answer = f"{count} samples ({', '.join(content['arrays'])}) in {len(rows)} shards"
    metrics = {"task": "dataset", "answer": answer, "wall_seconds": seconds}
    metrics |= {"dataset_samples": count, "shards": len(rows)}
    metrics |= {"dataset_bytes": sum(shard.size for shard in rows)}
    metrics |= {"samples_per_second": sum(made for _, _, made in missing) / seconds}
    view = save_picture(folder, "scene", plotting.scene(scene, sensor.radar), "The first sample")
    parts, title = [view, quantity_table("Data set", metrics)], run.title or "Data set"
    said, note = f"{answer}.", run.note
    return write_report(folder, metrics, title, said, parts, again="dataset", note=note), answer


def make_shard(job: tuple[str, int, int]) -> bytes:
    """Write a shard as a tar file: the job of a worker.

    Args:
        job: The run file of the data set, the first sample, and how many.
    """
    text, first, count = job
    run = validate_run(tomllib.loads(text), Path("run.toml"))
    samples = ((index, make_sample(run, index)) for index in range(first, first + count))
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", PhysicsWarning)  # issued once, where the run began
        return shards.pack_shard(samples)


def make_sample(run: RunFile, index: int) -> dict[str, bytes]:
    """The files of a sample by the ends of their names: arrays, labels, and its own run file.

    Args:
        run: The run file of the data set.
        index: Index of the sample.
    """
    own = make_sample_run(run, index)
    with locate_errors(f"sample {index}"):
        scene, sensor = _build_sample(own)
        table = require_section(run, "dataset", "a data set")
        arrays = _simulate_signals(own, scene, sensor, table)
        begun, chirps = scene, own.chirps and own.chirps.build()  # labels refer to the start
        if chirps is not None:
            last = float(chirps.times(sensor.radar.shape[1]).max())
            begun = motion_tables.scene_at_start(own, scene, last)
        seen = labels.triangle_visibility(begun, sensor.radar)
    if table.masks:
        arrays["masks"] = torch.cat(list(seen.values()), dim=1).numpy()
    joints = motion_tables.joint_positions_at_start(own, begun)
    objects = labels.object_labels(begun, seen, table.classes, joints)
    label = {"index": index, "objects": objects, "radar": labels.radar_labels(sensor.radar)}
    files = {f"{name}.npy": shards.npy_bytes(array) for name, array in arrays.items()}
    text = json.dumps(label, ensure_ascii=False, allow_nan=False)
    return files | {"labels.json": text.encode(), "run.toml": to_toml(own).encode()}


def make_sample_run(run: RunFile, index: int) -> RunFile:
    """Return the run file of a sample, as `invertwin simulate` takes it.

    Args:
        run: The run file of the data set.
        index: Index of the sample.

    Raises:
        InputError: Drawn values that are no run file together; the message names the sample.
    """
    with locate_errors(f"sample {index}"):
        raw = draw_sample(run, run.dump_without_dataset(), index)
    return validate_run(raw, Path(f"sample {index}"))


def _build_sample(run: RunFile) -> tuple[Scene, SensorSetup]:
    scene = build.true_scene(run)
    radar = build.radar(require_section(run, "radar", "a sample"))
    grid = build.grid(require_section(run, "grid", "a sample"), radar)
    return scene, SensorSetup(run, radar, grid)


def _simulate_signals(
    run: RunFile, scene: Scene, sensor: SensorSetup, table: Any
) -> dict[str, np.ndarray]:
    """Simulate exact signals and the arrays derived from them, by name."""
    moving = power = torch.zeros(0)
    if run.chirps is None:
        simulated = simulate_exact(run, scene, sensor.radar, sensor.grid)
        beat, power = simulated.beat, simulated.spectrum
        kept = ("frame", "delay", "coefficient", "first", "last") if table.paths else ()
        more = {f"paths_{n}": getattr(simulated.paths, n).detach().numpy() for n in kept}
    else:
        chirps = run.chirps.build()
        beat, more = simulate_chirp_beats(run, scene, sensor.radar, chirps), {}
        if "map" in table.signals:
            power = doppler.range_doppler_angle(beat, sensor.radar, sensor.grid, chirps)
        if "micro_doppler" in table.signals:
            moving = doppler.frame_spectrogram(beat, sensor.radar, sensor.grid, chirps).power
    found = {"raw": beat.resolve_conj().to(torch.complex64), "map": power.float()}
    found["micro_doppler"] = moving.float()
    return {_ARRAY_NAMES[n]: found[n].numpy() for n in table.signals} | more


def _describe_arrays(run: RunFile) -> dict[str, shards.ArrayInfo]:
    """Describe the arrays for the manifest."""
    table = require_section(run, "dataset", "a data set")
    info = shards.ArrayInfo
    chirp, rate = ([], []) if run.chirps is None else (["chirp"], ["velocity"])
    known = {
        "beat": info(dims=["frame", *chirp, "tx", "rx", "sample"], unit=_FIELD_UNIT),
        "map": info(dims=["frame", *rate, "range", "u", "v"], unit="received over sent"),
        "micro_doppler": info(dims=["frame", "time", "velocity"], unit="received over sent"),
        "masks": info(dims=["frame", "triangle"], unit="share that is seen"),
    }
    units = {"frame": "number", "delay": "s", "coefficient": _FIELD_UNIT}
    known |= {f"paths_{name}": info(dims=["path"], unit=unit) for name, unit in units.items()}
    known |= {f"paths_{end}": info(dims=["path", "xyz"], unit="m") for end in ("first", "last")}
    held = {_ARRAY_NAMES[name] for name in table.signals} | ({"masks"} if table.masks else set())
    return {n: a for n, a in known.items() if n in held or (table.paths and "paths_" in n)}


def _read_finished_shard(folder: RunFolder, number: int) -> dict[str, Any] | None:
    """The manifest's row of a shard that an interrupted run has written whole, or None."""
    row, unfinished = _shard_row_path(number), folder.path / UNFINISHED
    whole = all((unfinished / name).exists() for name in (row, shards.shard_name(number)))
    return folder.read_json(row) if whole else None


def _shard_row_path(number: int) -> str:
    """Return the file that keeps a finished shard's manifest row until the run ends."""
    return f"{PARTS}/shard-{number:06d}.json"
