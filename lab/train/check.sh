#!/bin/sh
# Checks the trainer. PYTHON names the interpreter that has torch.
cd "$(dirname "$0")" && export OMP_WAIT_POLICY=passive && "${PYTHON:-python3}" check_heads.py && "${PYTHON:-python3}" check_gpu.py && exec "${PYTHON:-python3}" check.py
