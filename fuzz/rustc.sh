#!/usr/bin/env bash
# The compiler, made to count where an input leads in what reads inputs: `b2p` itself. The kernels go the same way whatever the numbers are, and run at
# full speed. Comparisons are not traced: that costs half of the executions, and what it helps to pass, checksums and lengths, our mutator puts right.
case " $* " in
    *" --crate-name b2p "* | *" --crate-name b2p_fuzz "*)
        exec "$@" -Ccodegen-units=1 -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=3 \
            -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table
        ;;
esac
exec "$@"
