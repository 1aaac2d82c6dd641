"""A simulated Universal Robots controller: a process of its own that unmodified clients connect to.

`python -m station.simulation.controller --help`; described in docs/contributor/simulator.md. It imports
neither numpy nor anything of the offline rooms, so it starts in 0.1 s.
"""
