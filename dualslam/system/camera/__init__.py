"""The camera as the run knows it: when lens and shutter are asked for, and how an answer enters."""
