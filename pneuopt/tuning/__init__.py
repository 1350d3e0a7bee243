"""From requirements to gains: `tune`, its methods, feasibility, relaxation, Pareto fronts, validation.

What a search finds is certified by `evaluation` before it is handed out. `studies`, `files`, `plotting` and `cli` may
import it; it never imports `models` or `identification`. A newcomer adds a method of search.
"""
