#!/bin/sh
# Checks the trainer. PYTHON names the interpreter that has torch.
cd "$(dirname "$0")" && OMP_WAIT_POLICY=passive exec "${PYTHON:-python3}" check.py
