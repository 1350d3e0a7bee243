"""From logs to parameters with confidence intervals, and what logs cannot identify.

`problem` poses it, `search` and `windows` solve it, `misfit`, `profiles` and `review` judge the estimates; `identify`
is the whole way. `experiments`, `studies`, `files`, `plotting`, `report` and `cli` may import it; it never imports
`models` or `tuning`. A newcomer adds a robust loss in `losses`. Read `identify` first.
"""
