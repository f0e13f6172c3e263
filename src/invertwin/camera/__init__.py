"""Pinhole cameras: silhouettes and depth, with derivatives of their outlines."""

from invertwin.camera.camera import Camera as Camera
from invertwin.camera.camera import CameraPose as CameraPose
from invertwin.camera.images import ImageSampling as ImageSampling
from invertwin.camera.images import depths as depths
from invertwin.camera.images import silhouettes as silhouettes
from invertwin.camera.photographs import Photograph as Photograph
from invertwin.camera.photographs import photograph as photograph
from invertwin.deprecation import rename_attributes

rename_attributes(__name__)
