"""Images of a recording: reflectivity, likelihood, point detections."""
