"""Floor 0: the words every part of Canopy shares. Types, messages, codec, keys, errors, the link."""
