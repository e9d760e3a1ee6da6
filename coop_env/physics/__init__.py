"""The physics twin of both robots, with real contact, in MuJoCo (extra ``physics``)."""
