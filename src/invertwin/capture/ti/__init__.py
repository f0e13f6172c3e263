"""Files of Texas Instruments' tools: settings of the SDK and of mmWave Studio, DCA1000 samples."""

from invertwin.capture.ti.dca1000 import read_recording as read_recording
from invertwin.capture.ti.dca1000 import read_samples as read_samples
from invertwin.capture.ti.dca1000 import read_settings as read_settings
from invertwin.capture.ti.dca1000 import recorded_files as recorded_files
from invertwin.capture.ti.dca1000 import write_samples as write_samples
from invertwin.capture.ti.device_limits import add_demo_times as add_demo_times
from invertwin.capture.ti.layouts import change_settings as change_settings
from invertwin.capture.ti.mmwave_studio import read_studio as read_studio
from invertwin.capture.ti.mmwave_studio import write_setup as write_setup
from invertwin.capture.ti.mmwave_studio import write_studio as write_studio
from invertwin.capture.ti.sdk_cfg import read_cfg as read_cfg
from invertwin.capture.ti.sdk_cfg import write_cfg as write_cfg
