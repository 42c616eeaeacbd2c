/* xABOUTx
 *
 * xSENTENCEx
 *
 * In a page, after a script with src="xNAMEx.js", also in one that is opened as a file:
 *
 *     const { Observer } = await xNAMEx.load();
 *     const observer = new Observer();
 *     const code = observer.step(y, dtxWITH_Ux);   // NaN in y marks what was not measured; 0 is ok
 *     observer.estimate().xFIRSTx;
 *
 * In Node: const xNAMEx = require("./xNAMEx.js"). Sizes are numbers of arrays row by row.
xSIGNALSx */
(function () {
"use strict";

const NAME = "xNAMEx", RATE = xRATEx, MEASUREMENTS = xMEASUREMENTSx, INPUTS = xINPUTSx, INPUT_AT_END = xAT_ENDx;
const RESULTS = xRESULTSx;
const MESSAGES = xMESSAGESx;
const OK = RESULTS.indexOf("OK"), COASTED = RESULTS.indexOf("COASTED");
/* Names and sizes of what the structures of the C hold, in order. */
const PARAMS = xPARAMSx;
const STATE = xSTATEx;
const OUTPUT = xOUTPUTx;
const WASM = "xWASMx";

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
            const all = new xARRAYx(calls.memory.buffer, calls.place(), ends[4]);
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
            if (!this.started) {
                const begun = this.#begin(0);
                if (this.started && INPUT_AT_END) this.#calls.step(0);
                return begun;
            }
            return this.#calls.step(dt);
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
else globalThis.xNAMEx = exported;
})();
