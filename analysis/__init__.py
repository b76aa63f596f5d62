"""What a sweep left behind: records, selection, tables, figures, report."""
