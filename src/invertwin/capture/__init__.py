"""Measured data in and out: captures, their files, readers, and backprojection."""

from invertwin.capture.backprojection import backproject as backproject
from invertwin.capture.backprojection import calibrate as calibrate
from invertwin.capture.backprojection import locate as locate
from invertwin.capture.capture import Capture as Capture
from invertwin.capture.channels import ChannelCalibration as ChannelCalibration
from invertwin.capture.channels import estimate_channels as estimate_channels
from invertwin.capture.chirp_capture import ChirpCapture as ChirpCapture
from invertwin.capture.chirps import ChirpData as ChirpData
from invertwin.capture.chirps import ChirpSettings as ChirpSettings
from invertwin.capture.chirps import adc_counts as adc_counts
from invertwin.capture.chirps import settings_of as settings_of
from invertwin.capture.cubes import from_openradar as from_openradar
from invertwin.capture.cubes import from_radarsimpy as from_radarsimpy
from invertwin.capture.cubes import to_openradar as to_openradar
from invertwin.capture.cubes import to_radarsimpy as to_radarsimpy
from invertwin.capture.faults import Fault as Fault
from invertwin.capture.faults import faults_of as faults_of
from invertwin.capture.faults import shown_ranges as shown_ranges
from invertwin.capture.reading import is_sweeps as is_sweeps
from invertwin.capture.reading import read as read
from invertwin.capture.signature_files import MeasuredSection as MeasuredSection
from invertwin.capture.signature_files import Touchstone as Touchstone
from invertwin.capture.signature_files import load_section as load_section
from invertwin.capture.signature_files import load_touchstone as load_touchstone
from invertwin.capture.track import Track as Track
