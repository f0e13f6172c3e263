"""Measured data in and out: captures, their files, readers, and backprojection."""

from invertwin.capture.backprojection import backproject as backproject
from invertwin.capture.backprojection import calibrate as calibrate
from invertwin.capture.backprojection import locate as locate
from invertwin.capture.capture import Capture as Capture
from invertwin.capture.channel_calibration import ChannelCalibration as ChannelCalibration
from invertwin.capture.channel_calibration import estimate_channels as estimate_channels
from invertwin.capture.chirp_capture import ChirpCapture as ChirpCapture
from invertwin.capture.chirps import ChirpData as ChirpData
from invertwin.capture.chirps import ChirpSettings as ChirpSettings
from invertwin.capture.chirps import adc_counts as adc_counts
from invertwin.capture.chirps import make_settings as make_settings
from invertwin.capture.faults import Fault as Fault
from invertwin.capture.faults import find_faults as find_faults
from invertwin.capture.faults import search_ranges as search_ranges
from invertwin.capture.readers.bags import BagMessages as BagMessages
from invertwin.capture.readers.bags import bag_topics as bag_topics
from invertwin.capture.readers.bags import read_clouds as read_clouds
from invertwin.capture.readers.bags import read_topic as read_topic
from invertwin.capture.readers.bags import read_track as read_track
from invertwin.capture.readers.cubes import from_openradar as from_openradar
from invertwin.capture.readers.cubes import from_radarsimpy as from_radarsimpy
from invertwin.capture.readers.cubes import to_openradar as to_openradar
from invertwin.capture.readers.cubes import to_radarsimpy as to_radarsimpy
from invertwin.capture.readers.read import is_sweeps as is_sweeps
from invertwin.capture.readers.read import read as read
from invertwin.capture.readers.touchstone import MeasuredRcs as MeasuredRcs
from invertwin.capture.readers.touchstone import Touchstone as Touchstone
from invertwin.capture.readers.touchstone import load_rcs as load_rcs
from invertwin.capture.readers.touchstone import load_touchstone as load_touchstone
from invertwin.capture.track import Track as Track
from invertwin.deprecation import rename_attributes

rename_attributes(__name__)
