"""Other ways to the derivative of a radar map, to be compared with ours; nothing builds on them."""
