"""From the internal state of a diagnosis to the plain numbers of its result; the last part that simulates."""
