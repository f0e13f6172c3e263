"""Beamforming, direction finding, Doppler processing, detection, backprojection."""
