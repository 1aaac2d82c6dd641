"""A simulated Universal Robots controller: a process of its own that unmodified clients connect to.

`python -m station.simulation.controller --help`; described in docs/contributor/simulator.md. It starts
without NumPy and without anything of the offline packages, in 0.1 s.
"""
