/* Self-test of xNAMEx.js: `node test/xNAMEx_test.js`. xSENTENCEx */
"use strict";

const { load } = require("../xNAMEx.js");

const start = xSTARTx;
const steps = xSTEPSx;
const inputs = xINPUT_ROWSx;
const measured = xMEASUREDx;
const expected = xEXPECTEDx;
/* Ten times what roundings at random make of the same run. */
const allowed = xALLOWEDx;
/* The outcome of each step, or -1 where rounding decides it. */
const outcomes = xOUTCOMESx;

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
    console.log(`xNAMEx: ${verdict}, ${steps.length} steps, largest deviation ${worst.toFixed(3)} of the allowed one`);
    process.exitCode = wrong ? 1 : 0;
});
