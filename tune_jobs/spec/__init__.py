"""The sweep file: its typed model, its rules, and how it is read."""
