"""The loop around a plant: PID and its forms, dither, feedforward, compensators, references, sensors, wiring, rest.

A `ClosedLoop` joins them to one system, continuous or sampled. `evaluation`, `tuning`, `identification` and the rooms
above may import it; it imports `dynamics` and `quantities` and knows no plant. A newcomer adds a form of the controller
in `pid`, a sensor in `sensor`, a waveform in `dither`, a compensator in `compensators`. Read `controller` first.
"""
