"""Files of Texas Instruments' tools: settings of the SDK and of mmWave Studio, DCA1000 samples."""

from invertwin.capture.ti.dca1000 import read, read_recording, read_samples, write_samples
from invertwin.capture.ti.mmwave_studio import read_studio, write_setup, write_studio
from invertwin.capture.ti.sdk_cfg import read_cfg, write_cfg
from invertwin.capture.ti.settings_files import read_settings, recorded_files

__all__ = [
    "read",
    "read_cfg",
    "read_recording",
    "read_samples",
    "read_settings",
    "read_studio",
    "recorded_files",
    "write_cfg",
    "write_samples",
    "write_setup",
    "write_studio",
]
