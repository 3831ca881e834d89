"""One move each: what an engine composes into a sweep. A kernel knows its node's blanket, no engine."""
