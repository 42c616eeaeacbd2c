/* A node of ROS 2 on rcl: joint states in, joint states with estimated velocities out.
 *
 * xABOUTx
 *
 * xSENTENCEx
 */
#include "xNAMEx.h"

#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>

#include <diagnostic_msgs/msg/diagnostic_array.h>
#include <diagnostic_msgs/msg/diagnostic_status.h>
#include <diagnostic_msgs/msg/key_value.h>
#include <rcl/arguments.h>
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rcl_yaml_param_parser/parser.h>
#include <rosidl_runtime_c/primitives_sequence_functions.h>
#include <rosidl_runtime_c/string_functions.h>
#include <sensor_msgs/msg/joint_state.h>

#define JOINTS xUPPERx_MEASUREMENTS
#define LONGEST_GAP xLONGEST_GAPx /* s between samples; after a longer one the estimate starts anew */
#define SET_BACK xSET_BACKx /* samples in a row with earlier stamps after which the clock counts as set back */
#define DEPTH 1000 /* two seconds at 500 Hz */
#define LINES 256 /* most messages that are taken before the diagnostics are looked at */

static const char *const joints[JOINTS] = {xJOINTS_Cx};
static xNAMEx_params params;
/* Numbers of the model, set at the start by -p model.NAME:=VALUE, as model.mass_1 where there are several. */
static const struct {
    const char *name;
    xNAMEx_real *value;
} numbers[] = {
    /* xNUMBERSx */
    {NULL, NULL},
};

enum { SAMPLES, ACCEPTED, COASTED, REFUSED, LATE, REPEATED, RESTARTS, GAPS, INCOMPLETE, COUNTS };
static const char *const count_names[COUNTS] = {
    "samples", "accepted", "coasted", "refused", "late", "repeated", "restarts", "gaps", "incomplete"};
static unsigned long counts[COUNTS];
static volatile sig_atomic_t running = 1;

static xNAMEx_state state;
static xNAMEx_real acting[xUx];
static int started, back, has_acting;
static long long stamp;

static void stop(int number)
{
    (void)number;
    running = 0;
}

static void fail(const char *what)
{
    fprintf(stderr, "xNAMEx: %s: %s\n", what, rcl_get_error_string().str);
    rcl_reset_error();
}

/* Numbers of a message in the order of the model, NaN where it has none; returns how many it has. */
static int by_name(const rosidl_runtime_c__String__Sequence *names, const rosidl_runtime_c__double__Sequence *values,
    xNAMEx_real *out)
{
    int found = 0;
    for (size_t i = 0; i < JOINTS; ++i) {
        out[i] = (xNAMEx_real)NAN;
        for (size_t k = 0; k < names->size && k < values->size; ++k)
            if (strcmp(names->data[k].data, joints[i]) == 0) {
                out[i] = (xNAMEx_real)values->data[k];
                found += !isnan(values->data[k]);
            }
    }
    return found;
}

static void count(int result)
{
    switch (result) {
    case xUPPERx_COASTED: counts[COASTED]++; break;
    case xUPPERx_OUTLIER: counts[REFUSED]++; break;
    case xUPPERx_STEP_REFUSED: counts[LATE]++; break;
    case xUPPERx_RESTARTED:
    case xUPPERx_NOT_FINITE: counts[RESTARTS]++; break;
    default: counts[ACCEPTED]++;
    }
}

/* One sample; returns whether there is an estimate to publish. */
static int take(const sensor_msgs__msg__JointState *message)
{
    const long long now = message->header.stamp.sec * 1000000000LL + message->header.stamp.nanosec;
    xNAMEx_real y[JOINTS], effort[JOINTS];
    const int complete = by_name(&message->name, &message->position, y) == JOINTS;
    const int has_effort = xUSE_EFFORT_Cx && message->effort.size > 0;
    double dt = 1e-9 * (double)(now - stamp);
    int result;

    counts[SAMPLES]++;
    counts[INCOMPLETE] += !complete;
    by_name(&message->name, &message->effort, effort);
    if (started && dt <= 0) {
        counts[dt < 0 ? LATE : REPEATED]++;
        back = dt < 0 ? back + 1 : 0;
        if (back < SET_BACK)
            return 0;
    }
    if (started && (dt > LONGEST_GAP || dt < 0)) {
        counts[RESTARTS]++;
        started = has_acting = 0;
    }
    back = 0;
    if (started) {
        const xNAMEx_real *u = xAT_ENDx ? (has_effort ? effort : NULL) : (has_acting ? acting : NULL);
        counts[GAPS] += dt > 1.5 / xRATEx;
        result = xNAMEx_step(&state, &params, u, y, NULL, (xNAMEx_real)dt);
        if (result == xUPPERx_NOT_FINITE)
            started = 0;
    } else {
        started = complete && xNAMEx_init(&state, &params, y, 0) == xUPPERx_OK;
        result = started ? xUPPERx_OK : xUPPERx_COASTED;
    }
    stamp = now;
    has_acting = has_effort && started;
    if (has_acting)
        memcpy(acting, effort, sizeof(xNAMEx_real) * xINPUTSx);
    count(result);
    return started;
}

static void report(rcl_publisher_t *publisher, diagnostic_msgs__msg__DiagnosticArray *array, rcl_clock_t *clock)
{
    char text[32];
    rcl_time_point_value_t now = 0;
    diagnostic_msgs__msg__DiagnosticStatus *status = &array->status.data[0];

    for (size_t k = 0; k < COUNTS; ++k) {
        snprintf(text, sizeof text, "%lu", counts[k]);
        rosidl_runtime_c__String__assign(&status->values.data[k].value, text);
    }
    status->level = !started ? diagnostic_msgs__msg__DiagnosticStatus__STALE
        : counts[REFUSED] + counts[LATE] + counts[RESTARTS] > 0 ? diagnostic_msgs__msg__DiagnosticStatus__WARN
                                                                : diagnostic_msgs__msg__DiagnosticStatus__OK;
    if (rcl_clock_get_now(clock, &now) == RCL_RET_OK) {
        array->header.stamp.sec = (int32_t)(now / 1000000000);
        array->header.stamp.nanosec = (uint32_t)(now % 1000000000);
    }
    if (rcl_publish(publisher, array, NULL) != RCL_RET_OK)
        fail("publish");
}

/* Numbers that were given on the command line or in a file of parameters. */
static void read_numbers(const rcl_arguments_t *arguments)
{
    rcl_params_t *given = NULL;

    if (rcl_arguments_get_param_overrides(arguments, &given) != RCL_RET_OK || given == NULL)
        return;
    for (size_t n = 0; n < given->num_nodes; ++n)
        for (size_t k = 0; k < given->params[n].num_params; ++k)
            for (size_t i = 0; numbers[i].name != NULL; ++i) {
                const rcl_variant_t *value = &given->params[n].parameter_values[k];
                if (strcmp(given->params[n].parameter_names[k], numbers[i].name) != 0)
                    continue;
                if (value->double_value != NULL)
                    *numbers[i].value = (xNAMEx_real)*value->double_value;
                else if (value->integer_value != NULL)
                    *numbers[i].value = (xNAMEx_real)*value->integer_value;
            }
    rcl_yaml_node_struct_fini(given);
}

#define TRY(call)           \
    do {                    \
        if ((call) != RCL_RET_OK) { \
            fail(#call);    \
            return 1;       \
        }                   \
    } while (0)

int main(int argc, char **argv)
{
    rcl_allocator_t allocator = rcl_get_default_allocator();
    rcl_init_options_t options = rcl_get_zero_initialized_init_options();
    rcl_context_t context = rcl_get_zero_initialized_context();
    rcl_node_t node = rcl_get_zero_initialized_node();
    rcl_node_options_t node_options = rcl_node_get_default_options();
    rcl_subscription_t in = rcl_get_zero_initialized_subscription();
    rcl_subscription_options_t in_options = rcl_subscription_get_default_options();
    rcl_publisher_t out = rcl_get_zero_initialized_publisher(), diagnostics = rcl_get_zero_initialized_publisher();
    rcl_publisher_options_t out_options = rcl_publisher_get_default_options();
    rcl_publisher_options_t diagnostics_options = rcl_publisher_get_default_options();
    rcl_wait_set_t wait = rcl_get_zero_initialized_wait_set();
    rcl_clock_t clock;
    rcl_time_point_value_t now = 0, reported = 0;
    sensor_msgs__msg__JointState *seen = sensor_msgs__msg__JointState__create();
    sensor_msgs__msg__JointState *told = sensor_msgs__msg__JointState__create();
    diagnostic_msgs__msg__DiagnosticArray *array = diagnostic_msgs__msg__DiagnosticArray__create();
    xNAMEx_output estimate;

    params = xNAMEx_default;
    signal(SIGINT, stop);
    signal(SIGTERM, stop);
    TRY(rcl_init_options_init(&options, allocator));
    TRY(rcl_init(argc, (const char *const *)argv, &options, &context));
    read_numbers(&context.global_arguments);
    TRY(rcl_node_init(&node, "xNAMEx_observer", "", &context, &node_options));
    in_options.qos.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
    in_options.qos.depth = out_options.qos.depth = DEPTH;
    TRY(rcl_subscription_init(
        &in, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(sensor_msgs, msg, JointState), "joint_states", &in_options));
    TRY(rcl_publisher_init(
        &out, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(sensor_msgs, msg, JointState), "joint_states_estimated", &out_options));
    TRY(rcl_publisher_init(&diagnostics, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(diagnostic_msgs, msg, DiagnosticArray),
        "/diagnostics", &diagnostics_options));
    TRY(rcl_clock_init(RCL_SYSTEM_TIME, &clock, &allocator));
    TRY(rcl_wait_set_init(&wait, 1, 0, 0, 0, 0, 0, &context, allocator));

    if (!rosidl_runtime_c__String__Sequence__init(&told->name, JOINTS)
        || !rosidl_runtime_c__double__Sequence__init(&told->position, JOINTS)
        || !rosidl_runtime_c__double__Sequence__init(&told->velocity, JOINTS)
#if xHAS_FORCEx
        || !rosidl_runtime_c__double__Sequence__init(&told->effort, JOINTS)
#endif
        || !diagnostic_msgs__msg__DiagnosticStatus__Sequence__init(&array->status, 1)
        || !diagnostic_msgs__msg__KeyValue__Sequence__init(&array->status.data[0].values, COUNTS))
        return 1; /* no memory */
    for (size_t i = 0; i < JOINTS; ++i)
        rosidl_runtime_c__String__assign(&told->name.data[i], joints[i]);
    rosidl_runtime_c__String__assign(&array->status.data[0].name, "xNAMEx_observer");
    rosidl_runtime_c__String__assign(&array->status.data[0].hardware_id, "xNAMEx");
    for (size_t k = 0; k < COUNTS; ++k)
        rosidl_runtime_c__String__assign(&array->status.data[0].values.data[k].key, count_names[k]);

    while (running) {
        if (rcl_wait_set_clear(&wait) != RCL_RET_OK || rcl_wait_set_add_subscription(&wait, &in, NULL) != RCL_RET_OK)
            break;
        if (rcl_wait(&wait, RCL_MS_TO_NS(100)) != RCL_RET_OK)
            rcl_reset_error(); /* without a message it times out */
        for (int k = 0; k < LINES && rcl_take(&in, seen, NULL, NULL) == RCL_RET_OK; ++k) {
            if (!take(seen))
                continue;
            xNAMEx_estimate(&state, &params, &estimate);
            told->header.stamp = seen->header.stamp;
            rosidl_runtime_c__String__assign(&told->header.frame_id, seen->header.frame_id.data);
            for (size_t i = 0; i < JOINTS; ++i) {
                told->position.data[i] = estimate.q[i];
                told->velocity.data[i] = estimate.v[i];
#if xHAS_FORCEx
                told->effort.data[i] = state.xFORCE_FIELDx[i];
#endif
            }
            if (rcl_publish(&out, told, NULL) != RCL_RET_OK)
                fail("publish");
        }
        rcl_reset_error();
        if (rcl_clock_get_now(&clock, &now) == RCL_RET_OK && now - reported >= RCL_S_TO_NS(1)) {
            report(&diagnostics, array, &clock);
            reported = now;
        }
    }
    TRY(rcl_publisher_fini(&diagnostics, &node));
    TRY(rcl_publisher_fini(&out, &node));
    TRY(rcl_subscription_fini(&in, &node));
    TRY(rcl_node_fini(&node));
    TRY(rcl_shutdown(&context));
    return 0;
}
