"""Data sets of simulated recordings: distributions, labels, shards, and their reader."""

from invertwin.datasets.distributions import UNCHANGED as UNCHANGED
from invertwin.datasets.distributions import Choice as Choice
from invertwin.datasets.distributions import Distribution as Distribution
from invertwin.datasets.distributions import Integer as Integer
from invertwin.datasets.distributions import LogUniform as LogUniform
from invertwin.datasets.distributions import Normal as Normal
from invertwin.datasets.distributions import Presence as Presence
from invertwin.datasets.distributions import Uniform as Uniform
from invertwin.datasets.labels import object_labels as object_labels
from invertwin.datasets.labels import radar_labels as radar_labels
from invertwin.datasets.labels import triangle_visibility as triangle_visibility
from invertwin.datasets.reader import SampleDataset as SampleDataset
from invertwin.datasets.shards import DatasetManifest as DatasetManifest
from invertwin.deprecation import rename_attributes

rename_attributes(__name__)
