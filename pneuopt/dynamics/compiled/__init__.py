"""The same equations as cached machine code."""
