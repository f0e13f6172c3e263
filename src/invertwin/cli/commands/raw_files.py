"""Simulated samples as the files that boards and their tools write."""

import torch
from jaxtyping import Complex
from torch import Tensor

from invertwin.capture import ChirpSettings, adc_counts, make_settings, ti
from invertwin.cli.run_file import prefix_errors
from invertwin.cli.schema import RawTable, RunFile
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW
from invertwin.storage.run_folder import RunFolder

# A largest sample at this part of the full scale leaves room for those of other seeds.
_FULL_SCALE_MARGIN = 1.25


def make_chirp_settings(run: RunFile, radar: Radar) -> ChirpSettings:
    """Return the board settings that would record the simulated data of the run file.

    Raises:
        InputError: A radar without ramps, simultaneous transmitters, or ramps that
            do not fit their interval.
    """
    if not isinstance(radar.waveform, FMCW):
        raise InputError(
            f'raw: expected radar.waveform.kind = "fmcw", got {type(radar.waveform).__name__}; '
            "raw files are those of FMCW boards: remove [raw]"
        )
    raw = run.raw or RawTable()
    ramp = raw.adc_start_time + radar.waveform.duration
    idle = 0.0
    if run.chirps is not None:
        if not run.chirps.tdm:
            raise InputError(
                "raw: expected transmitters that take turns, got chirps.tdm = false; "
                "raw files of transmitters that send at once cannot be separated"
            )
        idle = run.chirps.interval - ramp
        if idle < -1e-12:
            raise InputError(
                f"chirps.interval: expected at least the ramp's {ramp:g} s, got "
                f"{run.chirps.interval:g}; idle time comes on top"
            )
    board = None if run.radar is None else run.radar.board
    with prefix_errors("raw"):
        return make_settings(
            radar.waveform,
            (board and board.transmitters) or len(radar.transmitters.positions),
            (board and board.receivers) or len(radar.receivers.positions),
            loops=1 if run.chirps is None else run.chirps.count,
            frames=radar.frame_count,
            # To the nanosecond, as settings files have it.
            idle_time=round(max(idle, 0.0), 9),
            **raw.model_dump(exclude={"full_scale"}),
        )


def write_raw_files(
    run: RunFile,
    radar: Radar,
    beat: Complex[Tensor, "frame chirp tx rx sample"] | Complex[Tensor, "frame tx rx sample"],
    folder: RunFolder,
) -> dict[str, float]:
    """Write raw/capture.bin and its settings files; return numbers for metrics.json.

    Raises:
        InputError: Data that no such file can hold.
    """
    assert run.raw is not None
    settings = make_chirp_settings(run, radar)
    full_scale = run.raw.full_scale
    if full_scale is None:
        largest = float(torch.view_as_real(beat.resolve_conj()).abs().max())
        full_scale = _FULL_SCALE_MARGIN * largest if largest > 0 else 1.0
    with prefix_errors("raw"):
        data = adc_counts(beat, settings, full_scale)
        samples = folder.file("raw/capture.bin")
        ti.write_samples(samples, data)
        ti.write_cfg(folder.file("raw/capture.cfg"), settings)
        studio = folder.file("raw/capture.mmwave.json")
        ti.write_studio(studio, settings)
        ti.write_setup(folder.file("raw/capture.setup.json"), studio, [samples])
    return {"raw_full_scale": full_scale, "raw_bytes": samples.stat().st_size}
