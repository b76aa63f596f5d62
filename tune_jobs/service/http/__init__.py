"""The REST interface: routes, their models, and errors as problem documents."""
