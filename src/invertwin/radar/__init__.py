"""Radar data from paths: exact signals and their smooth surrogate, in plain torch."""

from invertwin.deprecation import rename_attributes, rename_members
from invertwin.radar.boards import BOARDS as BOARDS
from invertwin.radar.boards import Board as Board
from invertwin.radar.boards import board as board
from invertwin.radar.parameters import ClockOffset as ClockOffset
from invertwin.radar.parameters import RadarPose as RadarPose
from invertwin.radar.parameters import RadarTrajectory as RadarTrajectory
from invertwin.radar.parameters import RangeBias as RangeBias
from invertwin.radar.processing.backprojection import backproject_beat as backproject_beat
from invertwin.radar.processing.beamforming import beamform as beamform
from invertwin.radar.processing.beamforming import exact_spectrum as exact_spectrum
from invertwin.radar.processing.detection import PointCloud as PointCloud
from invertwin.radar.processing.detection import cell_averaging_cfar as cell_averaging_cfar
from invertwin.radar.processing.detection import ordered_statistics_cfar as ordered_statistics_cfar
from invertwin.radar.processing.detection import peaks as peaks
from invertwin.radar.processing.detection import point_cloud as point_cloud
from invertwin.radar.processing.detection import save_points as save_points
from invertwin.radar.processing.direction import capon as capon
from invertwin.radar.processing.direction import music as music
from invertwin.radar.processing.direction import source_count as source_count
from invertwin.radar.processing.doppler import Spectrogram as Spectrogram
from invertwin.radar.processing.doppler import compensate_tdm as compensate_tdm
from invertwin.radar.processing.doppler import interpolate_rates as interpolate_rates
from invertwin.radar.processing.doppler import micro_doppler as micro_doppler
from invertwin.radar.processing.doppler import range_doppler as range_doppler
from invertwin.radar.processing.doppler import range_doppler_angle as range_doppler_angle
from invertwin.radar.processing.doppler import resolve_fold as resolve_fold
from invertwin.radar.processing.doppler import velocity_axis as velocity_axis
from invertwin.radar.processing.doppler import velocity_span as velocity_span
from invertwin.radar.processing.doppler_maps import DopplerMaps as DopplerMaps
from invertwin.radar.processing.doppler_maps import Peak as Peak
from invertwin.radar.processing.doppler_maps import doppler_maps as doppler_maps
from invertwin.radar.processing.doppler_maps import doppler_snapshots as doppler_snapshots
from invertwin.radar.processing.doppler_maps import find_peak as find_peak
from invertwin.radar.processing.doppler_maps import high_resolution_map as high_resolution_map
from invertwin.radar.processing.reflectors import detect_points as detect_points
from invertwin.radar.processing.reflectors import format_points_csv as format_points_csv
from invertwin.radar.processing.reflectors import noise_power as noise_power
from invertwin.radar.radar import Radar as Radar
from invertwin.radar.signal.chirps import Chirps as Chirps
from invertwin.radar.signal.chirps import moving_beat as moving_beat
from invertwin.radar.signal.chirps import range_rate as range_rate
from invertwin.radar.signal.impairments import ADC as ADC
from invertwin.radar.signal.impairments import Impairments as Impairments
from invertwin.radar.signal.impairments import Leakage as Leakage
from invertwin.radar.signal.impairments import PhaseNoise as PhaseNoise
from invertwin.radar.signal.impairments import channel_errors as channel_errors
from invertwin.radar.signal.impairments import leakage_signal as leakage_signal
from invertwin.radar.signal.impairments import noisy_oscillator_beat as noisy_oscillator_beat
from invertwin.radar.signal.impairments import quantize as quantize
from invertwin.radar.signal.impairments import residual_phase as residual_phase
from invertwin.radar.signal.range_profile import add_noise as add_noise
from invertwin.radar.signal.range_profile import beat_signal as beat_signal
from invertwin.radar.signal.range_profile import range_profile as range_profile
from invertwin.radar.surrogate.point_spread import airy as airy
from invertwin.radar.surrogate.point_spread import dirichlet as dirichlet
from invertwin.radar.surrogate.point_spread import normalized_gaussian as normalized_gaussian
from invertwin.radar.surrogate.surrogate import SURROGATES as SURROGATES
from invertwin.radar.surrogate.surrogate import Surrogate as Surrogate
from invertwin.radar.surrogate.surrogate import resolve_surrogate as resolve_surrogate
from invertwin.radar.surrogate.surrogate import surrogate_spectrum as surrogate_spectrum
from invertwin.radar.waveform import FMCW as FMCW
from invertwin.radar.waveform import OFDM as OFDM
from invertwin.radar.waveform import Impulse as Impulse
from invertwin.radar.waveform import PhysicsWarning as PhysicsWarning
from invertwin.radar.waveform import SampledWaveform as SampledWaveform
from invertwin.radar.waveform import SteppedFrequency as SteppedFrequency
from invertwin.radar.waveform import Waveform as Waveform

rename_attributes(__name__)
rename_members(
    DopplerMaps,
    everything="total_power",
    mover="moving_peak",
    movers="moving_power",
    strongest="strongest_peak",
)
rename_members(OFDM, received="receive_symbols")
rename_members(Radar, biased="has_range_bias", centered="center_on", moved="transform_rigidly")
rename_members(Surrogate, narrowed="scale_blur", widened="has_blur")
