"""The checks of the log doctor, a function each, from a log to its findings.

A newcomer writes ``check(experiment, axis) -> Iterator[LogFinding]`` in the file of its subject and a row in
`logs.doctor.CHECKS`.
"""
