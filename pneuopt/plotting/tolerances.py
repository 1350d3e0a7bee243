"""The numbers that decide in `plotting` what is drawn, each with its unit; sizes are in `canvas.STYLE`."""

MAX_PLOT_COLUMNS = 3  # columns of axes beside each other: more cannot be read at 1000 pixels, fewer leave logs out
MAX_PLOT_CHANNELS = 4  # channels below each other: more cannot be read, fewer leave channels out
MAX_PANELS = 6  # parameters that are drawn: more do not fit a page, and those with an alarm come first
MAX_NUMBERED_CELLS = 12  # cells along an axis up to which each has room for its number; with more, numbers overlap
MAX_PLOT_POINTS = 4000  # of a measured line or cloud: more make a vector figure slow to open, fewer hide short events
MAX_VECTOR_MARKERS = 400  # of a cloud that is drawn as vectors: more would fill megabytes, so that an image is made
MAX_CORRELATION_LAG = 40  # largest lag of a correlation [samples]: more crowd the axis, fewer hide slow dynamics
NORMAL_QUANTILE_95 = 1.96  # half width of a band that holds 95 % of a normal distribution [standard deviations]
SLOPE_SAMPLES = 20  # of a local derivative: fewer leave noise, more round off fast motion
MAX_ZOOM_SHARE = 0.6  # share of a log [1] from which it is drawn once, not whole and enlarged
MIN_PLOTTED_SENSITIVITY = 0.03  # the lowest one that is drawn [1]: lower flattens the peak, higher cuts the slope off
SHOWN_LIMIT_SHARE = (
    0.35  # share of a panel's range [1] within which a limit is drawn: a farther one squeezes the signal
)
MARKED_SHARE = 0.95  # of the cases, whose bound is marked [1]: a larger one hangs on the last few of a hundred samples
