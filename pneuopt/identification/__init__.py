"""From logs to parameters with confidence intervals, and what logs cannot identify.

The estimation problem, its multi-start, robust losses, review of the residuals, model selection, profiles. `studies`,
`files`, `plotting` and `cli` may import it; it never imports `models` or `tuning`. A newcomer adds a robust loss in
`losses`, or a check of the logs in `checks`.
"""
