"""A table as rows of text."""


def cells(table):
    """Rows of text, a cell's lines joined by |, its marks in brackets."""
    return [
        ["|".join(cell.lines) + (f" {list(cell.marks)}" if cell.marks else "") for cell in line.cells]
        for lines in table.sections
        for line in lines
    ]
