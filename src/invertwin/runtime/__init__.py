"""The machine: libLLVM, threads, memory, engines, progress."""
