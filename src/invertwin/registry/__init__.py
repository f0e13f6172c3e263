"""Tables of run files are made of constructors; plugins add theirs to the `Registry`."""

from invertwin.registry.kinds import Registry as Registry
