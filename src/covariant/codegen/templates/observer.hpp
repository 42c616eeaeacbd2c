/* xABOUTx
 *
 * xSENTENCEx
 */
#ifndef xUPPERx_HPP
#define xUPPERx_HPP

#include "xNAMEx.h"

#include <cstddef>

namespace xNAMEx {

/* An observer with its numbers and its state. A copy goes on from where the original is. */
class Observer {
public:
    typedef xNAMEx_real Real;

    explicit Observer(const xNAMEx_params &numbers = xNAMEx_default) : params(numbers), state_(), started_(false) {}

    bool started() const { return started_; }

    /* Start at rest at a measurement that is complete; returns the outcome. */
    int start(const Real *y, Real t = 0) {
        const int outcome = xNAMEx_init(&state_, &params, y, t);
        started_ = outcome == xUPPERx_OK;
        return outcome;
    }

    /* Advance by dt [s], then correct by y. The first complete measurement starts the observer. */
    int step(const Real *y, Real dt, const Real *u = NULL, const unsigned char *missing = NULL) {
        return started_ ? xNAMEx_step(&state_, &params, u, y, missing, dt) : start(y);
    }

    xNAMEx_output estimate() const {
        xNAMEx_output output;
        xNAMEx_estimate(&state_, &params, &output);
        return output;
    }

    const xNAMEx_state &state() const { return state_; }

    xNAMEx_params params; /* may be changed between steps */

private:
    xNAMEx_state state_;
    bool started_;
};

} /* namespace xNAMEx */

#endif
