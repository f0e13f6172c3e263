"""Pinhole cameras: silhouettes and depth, with derivatives of their outlines."""

from invertwin.camera.camera import Camera as Camera
from invertwin.camera.camera import CameraPose as CameraPose
from invertwin.camera.images import ImageSampling as ImageSampling
from invertwin.camera.images import depths as depths
from invertwin.camera.images import silhouettes as silhouettes
from invertwin.camera.photographs import Photograph as Photograph
from invertwin.camera.photographs import photograph as photograph
from invertwin.deprecation import rename_members

rename_members(
    Camera,
    detached="detach",
    local="to_camera_axes",
    looking="look_at",
    middle="principal_point",
    moved="transform_rigidly",
    moves="is_differentiated",
)
