"""An independent simulator of arms of flexible links in MuJoCo.

It imports nothing of vjm. Nothing is imported here, so that tests beside it can be skipped where MuJoCo is missing.
"""
