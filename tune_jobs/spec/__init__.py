"""The sweep file as a typed model."""
