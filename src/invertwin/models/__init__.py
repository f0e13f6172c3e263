"""Forward models, one file a kind of sensor."""
