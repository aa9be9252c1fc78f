"""The texts of `export_c`'s files; $names are filled in."""

from __future__ import annotations

HEADER = """\
/* controller.h: torque control of an arm whose kinematics are not exactly known.
 *
$made_from
 *
 * Call ${prefix}_init once, and ${prefix}_step once a period, with the same state. Any number of
 * states may be in use, in any threads: there is no other memory, no allocation and no input or
 * output. Arrays are of the sizes below; no pointer may be null.
 */
#ifndef ${PREFIX}_CONTROLLER_H
#define ${PREFIX}_CONTROLLER_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
    ${PREFIX}_N_Q = $nq, /* numbers of a configuration */
    ${PREFIX}_N_V = $nv, /* joints */
    ${PREFIX}_N_X = $n_x, /* numbers of a task value */
    ${PREFIX}_M = $m, /* numbers of a task error */
    ${PREFIX}_M_X = $m_x, /* and of the rate of a task value */
    ${PREFIX}_N_STATE = $n_state /* numbers of the state */
};

/* What happened in a step. Below zero: it was refused, see the torque of each. */
typedef enum {
    /* t is not finite, or t_x is INFINITY or more than 1 s after t, as by another clock: the torque
       is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_T = -7,
    /* dt is not positive or not finite: the torque is that of the law, the state stays */
    ${PREFIX}_REFUSED_DT = -6,
    /* a number of the target is not finite: x counts as lost, the joints come to rest, nothing is
       learnt */
    ${PREFIX}_REFUSED_TARGET = -5,
    /* the torque or the next state overflows: the torque is zero, the state stays */
    ${PREFIX}_REFUSED_OVERFLOW = -4,
    /* a number of the state is not finite: the torque is zero; call init again */
    ${PREFIX}_REFUSED_STATE = -3,
    /* a joint velocity is not finite: the torque is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_V = -2,
    /* q is not finite, an angle is beyond 1e6 rad, or (cos, sin) are off the unit circle: the
       torque is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_Q = -1,
$statuses
} ${prefix}_status;

/* What limits did to the torque of the law. Whatever is said below of joints that go on learning,
   with limits of torques alone nothing is learnt where the proof is given up, and nothing where
   the torque is limited without it. */
typedef enum {
$limit_statuses
} ${prefix}_limit_status;

/* What goes from step to step. $state_words */
typedef struct {
    double values[$stored];
} ${prefix}_state;

/* What is measured. */
typedef struct {
$t_comment
    double t;
$q_comment
    double q[$nq];
$v_comment
    double v[$nv];
$x_comment
    double x[$n_x];
$t_x_comment
    double t_x;
} ${prefix}_measurement;

/* What is wanted. Zeros in v and a are a target at rest. */
typedef struct {
$target_comment
    double x[$n_x];
$target_v_comment
    double v[$m_x], a[$m_x];
} ${prefix}_target;

/* The answer to one measurement. */
typedef struct {
    double torque[$nv];   /* $commands; always finite */
    double e[$m];        /* task error [$e_units]; not finite where x is lost */
    double gravity[$nv];  /* gravity torque within the law's torque [$tau_units] */
    double J_hat[$m][$nv]; /* believed task Jacobian [$e_units, per unit of a joint] */
    double slack;       /* what limits add to V' [W]; 0 where it is not known */
    ${prefix}_status status;
    ${prefix}_limit_status limit_status;
} ${prefix}_answer;

/* Set the state before the first step from the first measurement.
 *
 * Returns 1; or 0 where the state needs a number of it that is not finite, and is not usable.
 */
int ${prefix}_init(${prefix}_state *state, const ${prefix}_measurement *now);

/* Take one step: fill the answer, move the state on, and return the answer's status.
 *
 * dt: time for which the torque is held [s].
 */
${prefix}_status ${prefix}_step(${prefix}_state *state, const ${prefix}_measurement *now,
    const ${prefix}_target *target, double dt, ${prefix}_answer *answer);

#ifdef __cplusplus
}
#endif

#endif
"""

SOURCE = """\
/* controller.c: see controller.h.
 *
$made_from
 *
 * Written by a program: change the controller that it was made from instead.
 */
#include "controller.h"

#include <float.h>
#include <math.h>
#include <stdint.h>

#ifdef __FAST_MATH__
#error "-ffast-math takes out the checks for numbers that are not finite"
#endif

/* With no fused multiply-adds the bits are the same everywhere. gcc does not know this pragma, but
   -ffp-contract=off (see CMakeLists.txt), which is its usual with -std=c99. */
#if !defined(__GNUC__) || defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

#define N_STATE ${PREFIX}_N_STATE
$helpers
static int is_finite(const double *values, int size)
{
    int i;
    for (i = 0; i < size; ++i) {
        if (!(fabs(values[i]) <= DBL_MAX)) {
            return 0;
        }
    }
    return 1;
}

static int is_configuration(const double *q)
{
    return $q_checks;
}

static ${prefix}_status refused(${prefix}_answer *answer, ${prefix}_status status)
{
    static const ${prefix}_answer zero;
    *answer = zero;
    answer->status = status;
    return status;
}

/* The law and its limits. What is in a block of `if` is needed only there. */
static void evaluate(const ${prefix}_measurement *now, const ${prefix}_target *target,
    const double *state, double dt, ${prefix}_answer *answer, double *after)
{
$lines
    (void)now, (void)target, (void)state, (void)dt;
$stores
}

int ${prefix}_init(${prefix}_state *state, const ${prefix}_measurement *now)
{
$first
    return is_finite(state->values, N_STATE);
}

${prefix}_status ${prefix}_step(${prefix}_state *state, const ${prefix}_measurement *now,
    const ${prefix}_target *target, double dt, ${prefix}_answer *answer)
{
    static const ${prefix}_target nowhere = {{$nowhere}, {0.0}, {0.0}};
    ${prefix}_measurement blind;
    double after[$stored];
    int i, is_target, is_dt;
    if (!is_configuration(now->q)) {
        return refused(answer, ${PREFIX}_REFUSED_Q);
    }
    if (!is_finite(now->v, ${PREFIX}_N_V)) {
        return refused(answer, ${PREFIX}_REFUSED_V);
    }
$t_checks    if (!is_finite(state->values, N_STATE)) {
        return refused(answer, ${PREFIX}_REFUSED_STATE);
    }
    is_target = is_finite(target->x, ${PREFIX}_N_X)$rate_checks;
    if (!is_target) {
        blind = *now;
        for (i = 0; i < ${PREFIX}_N_X; ++i) {
            blind.x[i] = NAN;
        }
        now = &blind;
    }
    is_dt = dt > 0.0 && dt <= DBL_MAX;
    evaluate(now, is_target ? target : &nowhere, state->values, is_dt ? dt : 0.0, answer, after);
    if (!is_finite(answer->torque, ${PREFIX}_N_V) || !is_finite(after, N_STATE)) {
        return refused(answer, ${PREFIX}_REFUSED_OVERFLOW);
    }
    if (!is_target) {
        answer->status = ${PREFIX}_REFUSED_TARGET;
    }
    if (!is_dt) {
        answer->status = ${PREFIX}_REFUSED_DT;
    } else {
        for (i = 0; i < N_STATE; ++i) {
            state->values[i] = after[i];
        }
    }
    return answer->status;
}
"""

POWER_OF_TWO = """
static double power_of_two(double shifted)
{
    union { double number; uint64_t bits; } both;
    both.number = shifted;
    both.bits <<= 52;
    return both.number;
}
"""

SELFTEST = """\
/* selftest.c: recorded steps, to the bit, and what is refused.
 *
 * The bits are those of a compiler that contracts and reorders nothing: see CMakeLists.txt.
 */
#include "controller.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

typedef struct {
    ${prefix}_measurement now;
    ${prefix}_target target;
    double torque[$nv], after[$stored], slack;
    int status, limit_status, begins;
} record;

static const record records[] = {
$records
};

static int is_zero(const double *values, int size)
{
    int i;
    for (i = 0; i < size; ++i) {
        if (values[i] != 0.0) {
            return 0;
        }
    }
    return 1;
}

int main(void)
{
    ${prefix}_state state;
    ${prefix}_answer answer;
    int failed = 0, i, k;
    const int count = (int)(sizeof records / sizeof records[0]);
    double largest = 0.0;
    ${prefix}_measurement bad = records[0].now;
    for (k = 0; k < count; ++k) {
        const record *r = &records[k];
        int status, is_same;
        if (r->begins && !${prefix}_init(&state, &r->now)) {
            printf("init failed\\n");
            return 1;
        }
        status = ${prefix}_step(&state, &r->now, &r->target, $dt, &answer);
        is_same = status == r->status && (int)answer.limit_status == r->limit_status
            && memcmp(answer.torque, r->torque, sizeof r->torque) == 0
            && memcmp(state.values, r->after, ${PREFIX}_N_STATE * sizeof(double)) == 0
            && memcmp(&answer.slack, &r->slack, sizeof r->slack) == 0;
        failed += !is_same;
        for (i = 0; i < ${PREFIX}_N_V; ++i) {
            largest = fmax(largest, fabs(answer.torque[i] - r->torque[i]));
        }
    }
    printf("%d of %d steps to the bit; largest difference of a torque %g\\n", count - failed, count,
        largest);
    bad.q[${PREFIX}_N_Q - 1] = NAN;
    if (${prefix}_step(&state, &bad, &records[0].target, $dt, &answer) != ${PREFIX}_REFUSED_Q
            || !is_zero(answer.torque, ${PREFIX}_N_V)) {
        printf("a q that is not finite was not refused\\n");
        ++failed;
    }
    return failed != 0;
}
"""

CMAKE = """\
# A controller as a library, and a self-test:
#   cmake -B build -DCMAKE_BUILD_TYPE=Release && cmake --build build && ctest --test-dir build
cmake_minimum_required(VERSION 3.10)
project(${prefix}_controller C)

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library(${prefix}_controller STATIC controller.c)
target_include_directories(${prefix}_controller PUBLIC $${CMAKE_CURRENT_SOURCE_DIR})
set_target_properties(${prefix}_controller PROPERTIES
  C_STANDARD 99 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON)
if(CMAKE_C_COMPILER_ID MATCHES "GNU|Clang")
  # the same bits on every machine: no fused multiply-adds. Never -ffast-math.
  target_compile_options(${prefix}_controller PRIVATE -ffp-contract=off)
endif()
if(UNIX)
  target_link_libraries(${prefix}_controller PUBLIC m)
endif()

add_executable(${prefix}_selftest selftest.c)
set_target_properties(${prefix}_selftest PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON)
target_link_libraries(${prefix}_selftest PRIVATE ${prefix}_controller)

enable_testing()
add_test(NAME selftest COMMAND ${prefix}_selftest)
"""
