"""Paths between antennas by the image method and the uniform theory of diffraction."""
