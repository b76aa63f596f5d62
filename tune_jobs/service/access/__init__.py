"""Who gets in: hosts and origins, tokens, limits of bodies, security headers and the audit log."""
