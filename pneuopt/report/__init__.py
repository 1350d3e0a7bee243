"""Results as one page of HTML that a colleague can be handed: verdict first, then figures, tables and where it is from.

A page is one file that needs no network; a script moves its last part, without which it is whole. This room knows what
a page of each result holds, `plotting` draws its figures, `export` writes its loop as JavaScript, and `cli` writes one
where --report asks for it. It does no arithmetic of its own beyond what a figure needs. A newcomer adds the page of a
result as a function ``result -> Page`` in a file of its own, and a row to `write_report`.
"""
