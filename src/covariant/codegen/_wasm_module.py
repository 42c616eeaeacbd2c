"""Texts around an observer as WebAssembly: the C that JavaScript calls, the script around it, and its self-test."""

CALLS = """/* The observer @NAME@ for JavaScript, which reads and writes its numbers in one place. @SENTENCE@ */
#include "@NAME@.h"

#include <stddef.h>

#define EXPORT(name) __attribute__((export_name(name)))

/* All are numbers of one type, so that they lie one after the other. */
static struct {
    @NAME@_params params;
    @NAME@_state state;
    @NAME@_output output;
    @NAME@_real y[@UPPER@_MEASUREMENTS], u[@UPPER@_INPUTS + 1];
} all;

EXPORT("place") void *place(void)
{
    return &all;
}

EXPORT("reset") void reset(void)
{
    all.params = @NAME@_default;
}

EXPORT("start") int start(double t)
{
    return @NAME@_init(&all.state, &all.params, all.y, (@NAME@_real)t);
}

EXPORT("step") int step(double dt)
{
    return @NAME@_step(&all.state, &all.params, all.u, all.y, NULL, (@NAME@_real)dt);
}

EXPORT("estimate") void estimate(void)
{
    @NAME@_estimate(&all.state, &all.params, &all.output);
}
"""

SCRIPT = """/* @ABOUT@
 *
 * @SENTENCE@
 *
 * In a page, after a script with src="@NAME@.js", also in one that is opened as a file:
 *
 *     const { Observer } = await @NAME@.load();
 *     const observer = new Observer();
 *     const code = observer.step(y, dt@WITH_U@);   // NaN in y marks what was not measured; 0 is ok
 *     observer.estimate().@FIRST@;
 *
 * In Node: const @NAME@ = require("./@NAME@.js"). Sizes are numbers of arrays row by row.
@SIGNALS@ */
(function () {
"use strict";

const NAME = "@NAME@", RATE = @RATE@, MEASUREMENTS = @MEASUREMENTS@, INPUTS = @INPUTS@;
const RESULTS = @RESULTS@;
const MESSAGES = @MESSAGES@;
const OK = RESULTS.indexOf("OK"), COASTED = RESULTS.indexOf("COASTED"), NOT_FINITE = RESULTS.indexOf("NOT_FINITE");
/* Names and sizes of what the structures of the C hold, in order. */
const PARAMS = @PARAMS@;
const STATE = @STATE@;
const OUTPUT = @OUTPUT@;
const WASM = "@WASM@";

const size = (fields) => fields.reduce((sum, [, count]) => sum + count, 0);

function views(flat, fields) {
    const arrays = {};
    let first = 0;
    for (const [name, count] of fields) {
        arrays[name] = flat.subarray(first, first + count);
        first += count;
    }
    return arrays;
}

function write(into, values, name) {
    const array = typeof values === "number" ? [values] : values;
    if (!array || array.length !== into.length)
        throw new RangeError(`${NAME}: ${name} needs ${into.length} numbers; got ${array ? array.length : array}`);
    into.set(array);
}

/* Compiles the observer; its memory is separate for each `new Observer()`. */
async function load() {
    const module = await WebAssembly.compile(Uint8Array.from(atob(WASM), (c) => c.charCodeAt(0)));

    /* The observer with its numbers and its state; `params` holds arrays that may be changed between two steps. */
    class Observer {
        #calls;
        #all;
        #y;
        #u;
        #output;

        constructor(params = {}) {
            const calls = new WebAssembly.Instance(module).exports;
            const counts = [PARAMS, STATE, OUTPUT].map((fields) => Math.max(1, size(fields)));
            const ends = [...counts, MEASUREMENTS, INPUTS + 1].map(((end) => (count) => (end += count))(0));
            const all = new @ARRAY@(calls.memory.buffer, calls.place(), ends[4]);
            this.#calls = calls;
            this.#all = all;
            calls._initialize?.(); // which some compilers write
            calls.reset();
            this.params = Object.freeze(views(all.subarray(0, ends[0]), PARAMS));
            this.state = Object.freeze(views(all.subarray(ends[0], ends[1]), STATE));
            this.#output = all.subarray(ends[1], ends[2]);
            this.#y = all.subarray(ends[2], ends[3]);
            this.#u = all.subarray(ends[3], ends[3] + INPUTS);
            this.started = false;
            for (const [name, value] of Object.entries(params)) {
                if (!(name in this.params))
                    throw new RangeError(
                        `${NAME} has no number ${name}; there are: ${Object.keys(this.params).join(", ") || "none"}`);
                write(this.params[name], value, name);
            }
        }

        /* Start at rest at a measurement, at the time t [s]; COASTED where it is not complete. */
        start(y, t = 0) {
            write(this.#y, y, "y");
            return this.#begin(t);
        }

        /* Advance by dt [s] under the input u, then correct by y. The first complete measurement starts it. */
        step(y, dt, u) {
            write(this.#y, y, "y");
            if (u === undefined || u === null) this.#u.fill(0);
            else write(this.#u, u, "u");
            if (!this.started) return this.#begin(0);
            const code = this.#calls.step(dt);
            if (code === NOT_FINITE) this.started = false;
            return code;
        }

        /* The estimate as arrays by name; NaN before the observer has started. */
        estimate() {
            if (this.started) this.#calls.estimate();
            else this.#output.fill(NaN);
            return views(this.#output.slice(), OUTPUT);
        }

        /* A snapshot, which goes on from where this observer is. */
        copy() {
            const other = new Observer();
            other.#all.set(this.#all);
            other.started = this.started;
            return other;
        }

        #begin(t) {
            this.started = this.#calls.start(t) === OK;
            return this.started ? OK : COASTED;
        }
    }

    return { Observer, RATE, RESULTS, MESSAGES };
}

const exported = { load, RATE, MEASUREMENTS, INPUTS, RESULTS, MESSAGES };
if (typeof module !== "undefined" && module.exports) module.exports = exported;
else globalThis.@NAME@ = exported;
})();
"""

SELF_TEST = """/* Self-test of @NAME@.js: `node test/@NAME@_test.js`. @SENTENCE@ */
"use strict";

const { load } = require("../@NAME@.js");

const start = @START@;
const steps = @STEPS@;
const inputs = @INPUT_ROWS@;
const measured = @MEASURED@;
const expected = @EXPECTED@;
/* Ten times what roundings at random make of the same run. */
const allowed = @ALLOWED@;
/* The outcome of each step, or -1 where rounding decides it. */
const outcomes = @OUTCOMES@;

load().then(({ Observer }) => {
    const observer = new Observer();
    let worst = 0;
    let wrong = observer.start(start) !== 0;
    steps.forEach((dt, row) => {
        const outcome = observer.step(measured[row], dt, inputs[row]);
        if (outcomes[row] >= 0 && outcome !== outcomes[row]) {
            console.log(`row ${row}: outcome ${outcome} in place of ${outcomes[row]}`);
            wrong = true;
        }
        Object.values(observer.estimate()).flatMap((array) => [...array]).forEach((value, i) => {
            if (Number.isNaN(expected[row][i])) return; // not known there, nor compared
            const part = Math.abs(value - expected[row][i]) / allowed[row][i];
            if (!(part <= 1)) {
                console.log(`row ${row}: number ${i} is ${value} in place of ${expected[row][i]}`);
                wrong = true;
            }
            worst = Math.max(worst, part);
        });
    });
    const verdict = wrong ? "WRONG" : "ok";
    console.log(`@NAME@: ${verdict}, ${steps.length} steps, largest deviation ${worst.toFixed(3)} of the allowed one`);
    process.exitCode = wrong ? 1 : 0;
});
"""
