"""The numbers that decide in `plotting`, each with its unit and what it decides."""


# Canvas

MAX_PLOT_COLUMNS = 3
"""Columns of axes beside each other: more cannot be read at 1000 pixels, fewer leave logs out."""
MAX_PLOT_POINTS = 4000
"""Points of a measured line or cloud: more make a vector figure slow to open, fewer hide short events."""
NORMAL_QUANTILE_95 = 1.96
"""Half width of a band that holds 95 % of a normal distribution [standard deviations]."""
MAX_VECTOR_MARKERS = 400
"""Markers of a cloud that are drawn as vectors: of more an image is made, as they would fill megabytes."""
RASTER_DPI = 200
"""Resolution of clouds that become an image [1/inch]: lower blurs in print, higher makes the page large."""

# Diagram

BLOCK_HEIGHT, CIRCLE_RADIUS, ARROW_LENGTH = 0.62, 0.12, 0.3  # [inch]; the arrow's where it has no label
BLOCK_TEXT, SMALL_TEXT = 9.0, 8.0  # [points] inside a block, and beside an arrow or below a block
LETTER_WIDTH = 0.064  # [inch] of a letter beside an arrow: with less, labels overlap; with more, arrows are long
LEGEND_LETTER_WIDTH = 0.055  # [inch] of a letter in running text: with less, lines run off the figure
MARGIN = 0.15  # [inch] around the diagram
SOURCE_HEIGHT, SENSOR_HEIGHT, WIRE_HEIGHT = 1.2, -1.45, -1.15  # [inch] of what is added, of the sensor, without one
PID_WIDTH, SOURCE_WIDTH, SMALL_WIDTH, PLANT_WIDTH = 2.1, 1.5, 0.8, 1.7  # [inch] of blocks
COMPENSATOR_WIDTH = 1.15  # [inch]
OUTPUT_SPACING = 0.32  # [inch] between the outputs of a plant: closer, their labels overlap
FRAME = 0.12  # [inch] between the controller and the frame around it
BRANCH = 0.15  # [inch] from an arrow's begin to where it divides

# Fits

MAX_CORRELATION_LAG = 40
"""Largest lag of a correlation [samples]: more crowd the axis, fewer hide slow dynamics."""
MAX_PLOT_CHANNELS = 4
"""Channels below each other: more cannot be read, fewer leave channels out."""
MAX_NUMBERED_PARAMETERS = 12
"""Parameters up to which each cell has room for its number; with more, numbers overlap."""
SLOPE_SAMPLES = 20  # of a local derivative

# Logs

MAX_ZOOM_SHARE = 0.6
"""Share of a log [1] from which it is drawn once, not whole and enlarged; lower, one event fills both columns."""
TITLE_WIDTH = 118
"""Letters of a line of the title: more are cut off at 10 inches, fewer take a line more."""
LABEL_WIDTH = 24
"""Letters of a line of a label beside an axis: more run into the next panel's, fewer make three lines."""

# Loops

CURVE_POINTS = 500  # of a reference: fewer show corners in its bends, more make figures larger
MIN_PLOTTED_SENSITIVITY = 0.03
"""The lowest sensitivity that is drawn [1]: lower flattens the peak, which matters; higher cuts the slope off."""

# Plans

MAX_SIGNALS = 4
"""Panels of signals [1]: more do not fit a page beside the intervals."""
INCHES_A_PARAMETER = 0.24
"""Height of a parameter's line [inch]: less and their names touch."""
TICKS = (1.0, 2.0, 5.0)
"""Numbers on a logarithmic axis, of each decade: more touch, one alone leaves short axes bare."""
SHOWN_LIMIT_SHARE = 0.35
"""Share of a panel's range [1] within which a limit is drawn: a farther one would squeeze the signal."""
MAX_PANELS = 6
"""Parameters that are drawn: more do not fit a page, and those with an alarm come first."""

# Studies

MAX_NUMBERED_CELLS = 12
"""Cells along an axis up to which each has room for its number; with more, numbers overlap."""
LABELS_PER_LONG_AXIS = 6
"""Labels along an axis of more cells than that: more overlap, fewer are hard to read between."""
MARKED_SHARE = 0.95
"""Share of the cases whose bound is marked [1]: a larger one hangs on the last few of a hundred samples."""
INCHES_AN_AXIS = 0.42
"""Height of an axis' two bars [inch]: less and their names touch, more and ten axes do not fit a page."""
