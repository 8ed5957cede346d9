"""What `tools/bench` measures: methods beside their rivals in one run, against an exact reference if there is one.

Nothing outside the command and the tests imports from here.
"""
