/* One decision: constraints, candidates, the nearest feasible action (SQP) and the least-violation action.

   The same algorithms as safety/solver/constraints.py, linearization.py, sqp.py, candidates.py, least_violation.py and
   safety/decision.py, in the same order, so that results have the same bits. What those answer by an exception, by the
   general solver or by NumPy is declined here: Python then answers. */

enum { MOST_ACTIONS = 2, MOST_STATES = 64, MOST_SEEN = 128 };

static const double NO_INFLUENCE = 1e-9, ROUNDING = 1e-10, TINY = 1e-300, REACH_ROUNDING = 1e-9, MARK = 1e-10;
static const double SAME = 1e-8, SERVED_WELL = 0.1, MOST_LEFT = 0.75, NEEDLESS = 0.05, OVERSHOOT = 0.25, LEFT = 0.9;
static const double DOUBTFUL = 0.02, FAR_AWAY = 0.1, NEAR = 0.01, BACK_STEP = 0.1, BEYOND = 2.0;
enum { TRIES = 4, HALVINGS = 5, STARTS = 3, SHARES = 6, MOST_CORNERS = 32 };
static const double STEP_SHARES[SHARES] = {0.24, 0.12, 0.06, 0.03, 0.015, 0.006};

typedef void step_function(const double *, const double *, const double *, const double *, const double *, double *);
typedef void tangent_function(
    const double *, const double *, const double *, const double *, const double *, double *, double *);
typedef void scene_function(const double *, const double *, double *);
typedef void h_function(
    const double *, const double *, const double *, const double *const *, const int *, double *);
typedef void slopes_function(
    const double *, const double *, const double *, const double *const *, const int *, const int *, int, double *);
typedef void bound_function(const double *, const double *, const double *, double *);

/* One caller's arrays of a compiled rollout, as in path_minimum.c. */
typedef struct {
    const double *k_step, *k_backup, *k_h, *latent, *held, *shared, *each;
    double time;
    int items, rows, ticks;
} rollout_setup;
typedef struct {
    rollout_setup u;
    double *origin, *x, *directions, *path, *memory, *values, *shares, *size, *out;
    int *flags, *points;
} rollout_call;
typedef struct {
    int (*run)(const rollout_call *, int), (*differences)(const rollout_call *, int, int);
    int (*gradient)(const rollout_call *, int, int); /* NULL: central differences of the whole path */
    rollout_call *call;
} rollout_functions;

typedef struct {
    h_function *h;
    slopes_function *slopes;
    bound_function *bound;
    const double *kept, *k;
    const double *const *items;
    const int *counts;
    int rows, states;
    const rollout_functions *rollout; /* in place of h and slopes */
} barrier_rows;

typedef struct {
    step_function *step;
    tangent_function *tangent;
    const double *k;
    int states, actions, latents;
} model_step;

typedef struct {
    int actions, rounds, affine;
    double eta, low[MOST_ACTIONS], high[MOST_ACTIONS], width[MOST_ACTIONS], weight[MOST_ACTIONS];
} decision_settings;

typedef struct {
    double action[MOST_ACTIONS], *next, *h, *residual, min_h;
    unsigned char *violated;
    int feasible;
    /* of a rollout: where each h is least on the path */
    int *points;
    double *shares;
} candidate;

typedef struct {
    double g[MOST_STATES * MOST_ACTIONS], reach, *row, *change;
    const candidate *about;
    unsigned char *known;
} tangent_plane;

typedef struct block {
    struct block *next;
    size_t used, size;
    double data[];
} block;

typedef struct {
    const decision_settings *set;
    const barrier_rows *barriers;
    /* Of several delays each has a state at which an action takes effect: a case. Rows and states of all cases, the
       states one after the other. */
    int cases, rows, states;
    const model_step *model;
    /* f and g of a model that is affine in the action, with its periods; else unused */
    const double *known;
    double period, trained_period;
    const double *state, *latent, *epsilon;
    const unsigned char *at_once;
    double time, min_h_now, *h_now, *rhs, *scales, *base_scales;
    double nominal[MOST_ACTIONS];
    double last_g[MOST_STATES * MOST_ACTIONS];
    int has_last_g, saturated;
    candidate *nominal_candidate, *found, *seen[MOST_SEEN];
    int seen_count;
    program_2d program;
    max_min lp;
    block *blocks, *current;
    jmp_buf declined;
    const char *why;
} decision;

static void decline(decision *d, const char *why)
{
    d->why = why;
    longjmp(d->declined, 1);
}

/* Memory that lasts until the next decision begins. */
static void *memory(decision *d, size_t bytes)
{
    const size_t words = (bytes + sizeof(double) - 1) / sizeof(double);
    while (!d->current || d->current->used + words > d->current->size) {
        block *next = d->current ? d->current->next : d->blocks;
        if (!next || next->size < words) {
            const size_t size = words > 8192 ? words : 8192;
            block *more = malloc(sizeof(block) + size * sizeof(double));
            if (!more)
                decline(d, "no memory");
            more->size = size, more->next = next;
            if (d->current)
                d->current->next = more;
            else
                d->blocks = more;
            next = more;
        }
        next->used = 0;
        d->current = next;
    }
    void *found = d->current->data + d->current->used;
    d->current->used += words;
    return found;
}

#define ARRAY(d, type, count) ((type *)memory((d), sizeof(type) * (size_t)((count) > 0 ? (count) : 1)))

static void forget(decision *d)
{
    d->current = NULL;
    d->seen_count = 0;
}

/* ---- floating-point exceptions: what Python raises for, NumPy answers ---- */

#if defined(__SSE2__)
#include <xmmintrin.h>
static inline void clear_flags(void) { _mm_setcsr(_mm_getcsr() & ~0x3fu); }
static inline int odd_numbers(void) { return _mm_getcsr() & (0x01 | 0x04 | 0x08); } /* invalid, by zero, overflow */
#else
#include <fenv.h>
static inline void clear_flags(void) { feclearexcept(FE_ALL_EXCEPT); }
static inline int odd_numbers(void) { return fetestexcept(FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW); }
#endif

static int all_finite(const double *values, int count)
{
    double total = 0.0;
    for (int i = 0; i < count; i++)
        total += values[i];
    if (total - total == 0.0)
        return 1;
    for (int i = 0; i < count; i++)
        if (values[i] - values[i] != 0.0)
            return 0;
    return 1;
}

static double smallest_of(const double *values, int count)
{
    double smallest = values[0];
    for (int i = 0; i < count; i++)
        smallest = values[i] < smallest ? values[i] : smallest;
    return smallest;
}

/* ---- model and barriers ---- */

/* Runs the path from the measured state over `state`; writes the least h. Returns the number of states on it. */
static int roll_out(decision *d, const double *state, double *h)
{
    const rollout_functions *r = d->barriers->rollout;
    const size_t size = sizeof(double) * (size_t)d->states;
    memcpy(r->call->origin, d->state, size);
    memcpy(r->call->x, state, size);
    r->call->u.time = d->time;
    const int count = r->run(r->call, 1);
    if (count < 0)
        decline(d, "a state on the path is not finite");
    memcpy(h, r->call->values, sizeof(double) * (size_t)d->rows);
    return count;
}

static void evaluate_h(decision *d, const double *state, double *h)
{
    const barrier_rows *b = d->barriers;
    if (b->rollout) {
        roll_out(d, state, h);
        if (!all_finite(h, d->rows))
            decline(d, "h is not finite");
        return;
    }
    clear_flags();
    for (int i = 0; i < d->cases; i++)
        b->h(state + i * b->states, b->kept, b->k, b->items, b->counts, h + i * b->rows);
    if (odd_numbers() || !all_finite(h, d->rows))
        decline(d, "h is not finite");
}

static void predict(decision *d, const double *action, double *next)
{
    const int states = d->states, actions = d->set->actions;
    clear_flags();
    if (d->known) {
        const double *entry = d->known + states;
        for (int row = 0; row < states; row++) {
            double effect = 0.0;
            for (int column = 0; column < actions; column++)
                effect += *entry++ * action[column];
            next[row] = d->state[row] + d->period * ((d->known[row] + effect) / d->trained_period);
        }
    } else
        for (int i = 0; i < d->cases; i++)
            d->model->step(d->state + i * d->barriers->states, action, d->latent, &d->time, d->model->k,
                           next + i * d->barriers->states);
    if (odd_numbers() || !all_finite(next, states))
        decline(d, "the predicted state is not finite");
}

/* h and its points on the path over the predicted state. A search meets the same state again and again. */
static void rolled_out(decision *d, candidate *c)
{
    const int rows = d->rows;
    const size_t size = sizeof(double) * (size_t)d->states;
    for (int i = 0; i < d->seen_count; i++)
        if (!memcmp(d->seen[i]->next, c->next, size)) {
            memcpy(c->h, d->seen[i]->h, sizeof(double) * (size_t)rows);
            c->points = d->seen[i]->points, c->shares = d->seen[i]->shares;
            return;
        }
    evaluate_h(d, c->next, c->h);
    const rollout_call *call = d->barriers->rollout->call;
    c->points = memcpy(ARRAY(d, int, rows), call->points, sizeof(int) * (size_t)rows);
    c->shares = memcpy(ARRAY(d, double, rows), call->shares, sizeof(double) * (size_t)rows);
    if (d->seen_count < MOST_SEEN)
        d->seen[d->seen_count++] = c;
}

static candidate *evaluate(decision *d, const double *action)
{
    const int rows = d->rows;
    candidate *c = ARRAY(d, candidate, 1);
    c->next = ARRAY(d, double, d->states);
    c->h = ARRAY(d, double, rows);
    c->residual = ARRAY(d, double, rows);
    c->violated = ARRAY(d, unsigned char, rows);
    memcpy(c->action, action, sizeof(double) * (size_t)d->set->actions);
    predict(d, action, c->next);
    if (d->barriers->rollout)
        rolled_out(d, c);
    else
        evaluate_h(d, c->next, c->h);
    int violations = 0;
    for (int row = 0; row < rows; row++) {
        const double slack = c->h[row] - d->rhs[row];
        c->residual[row] = slack;
        c->violated[row] = slack < 0.0 && slack < -ROUNDING * d->scales[row];
        violations += c->violated[row];
    }
    c->min_h = smallest_of(c->h, rows);
    c->feasible = violations == 0 && c->min_h >= 0.0;
    return c;
}

static double min_scaled_residual(const decision *d, const candidate *c)
{
    double smallest = c->residual[0] / d->scales[0];
    for (int row = 1; row < d->rows; row++)
        if (c->residual[row] < smallest * d->scales[row])
            smallest = c->residual[row] / d->scales[row];
    return smallest;
}

static void set_right_hand_side(decision *d)
{
    const int rows = d->rows;
    const double share = 1.0 - d->set->eta;
    d->h_now = ARRAY(d, double, rows);
    d->rhs = ARRAY(d, double, rows);
    d->scales = ARRAY(d, double, rows);
    d->base_scales = ARRAY(d, double, rows);
    evaluate_h(d, d->state, d->h_now);
    d->min_h_now = smallest_of(d->h_now, rows);
    for (int row = 0; row < rows; row++) {
        const double margin = d->epsilon[row], size = size_of(d->h_now[row]);
        d->rhs[row] = d->at_once[row] ? margin : share * d->h_now[row] + margin;
        d->scales[row] = d->base_scales[row] = size > margin ? size : margin > TINY ? margin : TINY;
    }
}

/* ---- linearisation ---- */

static void clip_action(const decision_settings *set, const double *action, double *clipped)
{
    for (int i = 0; i < set->actions; i++)
        clipped[i] = action[i] < set->low[i] ? set->low[i] : action[i] > set->high[i] ? set->high[i] : action[i];
}

static int is_saturated(const decision *d, const double *g, int column, const double *reached)
{
    for (int row = 0; row < d->states; row++) {
        const double motion = size_of(reached[row] - d->state[row]), size = size_of(reached[row]);
        const double noise = NO_INFLUENCE * (motion > size ? motion : size);
        if (!(size_of(g[row * d->set->actions + column]) * d->set->width[column] <= noise))
            return 0;
    }
    return 1;
}

static void control_matrix(decision *d, const candidate *about)
{
    const int states = d->states, actions = d->set->actions;
    double g[MOST_STATES * MOST_ACTIONS], next[MOST_STATES];
    if (d->known) {
        for (int i = 0; i < states * actions; i++)
            g[i] = d->period * (d->known[states + i] * 1e-30 / d->trained_period) / 1e-30;
    } else {
        const int own = d->barriers->states;
        clear_flags();
        for (int i = 0; i < d->cases; i++)
            d->model->tangent(d->state + i * own, about->action, d->latent, &d->time, d->model->k, next + i * own,
                              g + i * own * actions);
        if (odd_numbers())
            decline(d, "g is not finite");
    }
    if (!all_finite(g, states * actions))
        decline(d, "g is not finite");
    for (int column = 0; column < actions && !d->set->affine; column++) {
        if (!is_saturated(d, g, column, about->next))
            continue;
        d->saturated = 1;
        if (d->has_last_g) {
            for (int row = 0; row < states; row++)
                g[row * actions + column] = d->last_g[row * actions + column];
            continue;
        }
        const double value = about->action[column], low = d->set->low[column], high = d->set->high[column];
        const double end = value - low > high - value ? low : high;
        double other[MOST_ACTIONS];
        memcpy(other, about->action, sizeof other);
        other[column] = end;
        predict(d, other, next);
        for (int row = 0; row < states; row++)
            g[row * actions + column] = (next[row] - about->next[row]) / (end - value);
    }
    if (!all_finite(g, states * actions))
        decline(d, "a chord of the model is not finite");
    memcpy(d->last_g, g, sizeof(double) * (size_t)(states * actions));
    d->has_last_g = 1;
}

static tangent_plane *linearize(decision *d, const candidate *about)
{
    const int states = d->states, actions = d->set->actions, rows = d->rows;
    tangent_plane *t = ARRAY(d, tangent_plane, 1);
    if (!d->has_last_g || !d->set->affine)
        control_matrix(d, about);
    memcpy(t->g, d->last_g, sizeof(double) * (size_t)(states * actions));
    t->about = about;
    t->row = ARRAY(d, double, rows * actions);
    t->change = ARRAY(d, double, rows);
    t->known = ARRAY(d, unsigned char, rows);
    memset(t->known, 0, (size_t)rows);
    t->reach = INFINITY;
    if (d->barriers->bound) {
        double bound[MOST_STATES], reach = 0.0;
        clear_flags();
        for (int i = 0; i < d->cases; i++)
            d->barriers->bound(about->next + i * d->barriers->states, d->barriers->kept, d->barriers->k,
                               bound + i * d->barriers->states);
        if (odd_numbers())
            decline(d, "a bound of the slopes of h is not finite");
        for (int i = 0; i < states; i++)
            for (int column = 0; column < actions; column++)
                reach += bound[i] * size_of(t->g[i * actions + column]) * d->set->width[column];
        t->reach = reach * (1.0 + REACH_ROUNDING);
    }
    return t;
}

/* The row p'g from the slopes (states,) of one row, at its own case. */
static void chain_rule(const decision *d, tangent_plane *t, int row, const double *slopes)
{
    const int states = d->barriers->states, actions = d->set->actions;
    const double *g = t->g + row / d->barriers->rows * states * actions;
    for (int column = 0; column < actions; column++) {
        double total = 0.0;
        for (int s = 0; s < states; s++)
            total += slopes[s] * g[s * actions + column];
        t->row[row * actions + column] = total;
    }
}

/* The rows of a rollout: by the chain rule along the path, or by differences over the range of each action. */
static void rollout_rows(decision *d, tangent_plane *t, const int *unknown, int count)
{
    const rollout_functions *r = d->barriers->rollout;
    const int states = d->states, actions = d->set->actions, rows = d->rows;
    const candidate *about = t->about;
    if (r->gradient) {
        double *ignored = ARRAY(d, double, rows);
        const int length = roll_out(d, about->next, ignored);
        if (r->gradient(r->call, 1, length) < 0)
            decline(d, "no slopes along the path");
        for (int i = 0; i < count; i++)
            chain_rule(d, t, unknown[i], r->call->out + unknown[i] * states);
        return;
    }
    memcpy(r->call->origin, d->state, sizeof(double) * (size_t)states);
    memcpy(r->call->x, about->next, sizeof(double) * (size_t)states);
    memcpy(r->call->points, about->points, sizeof(int) * (size_t)rows);
    memcpy(r->call->shares, about->shares, sizeof(double) * (size_t)rows);
    r->call->u.time = d->time;
    for (int column = 0; column < actions; column++)
        for (int s = 0; s < states; s++)
            r->call->directions[column * states + s] = t->g[s * actions + column] * d->set->width[column];
    if (r->differences(r->call, 1, actions) < 0)
        decline(d, "a state on the path is not finite");
    for (int i = 0; i < count; i++)
        for (int column = 0; column < actions; column++)
            t->row[unknown[i] * actions + column] =
                r->call->out[unknown[i] * actions + column] / d->set->width[column];
}

static void compute_rows(decision *d, tangent_plane *t, const int *unknown, int count)
{
    const int actions = d->set->actions;
    if (!count)
        return;
    const barrier_rows *b = d->barriers;
    if (b->rollout)
        rollout_rows(d, t, unknown, count);
    else {
        double *slopes = ARRAY(d, double, count * b->states);
        int *own = ARRAY(d, int, count);
        clear_flags();
        /* the unknown rows are in order: those of one case follow each other */
        for (int i = 0, end; i < count; i = end) {
            const int one = unknown[i] / b->rows;
            for (end = i; end < count && unknown[end] / b->rows == one; end++)
                own[end] = unknown[end] % b->rows;
            b->slopes(t->about->next + one * b->states, b->kept, b->k, b->items, b->counts, own + i, end - i,
                      slopes + i * b->states);
        }
        if (odd_numbers())
            decline(d, "a slope of h is not finite");
        for (int i = 0; i < count; i++)
            chain_rule(d, t, unknown[i], slopes + i * b->states);
    }
    for (int i = 0; i < count; i++) {
        const int row = unknown[i];
        double change = 0.0;
        for (int column = 0; column < actions; column++)
            change += size_of(t->row[row * actions + column]) * d->set->width[column];
        if (change - change != 0.0)
            decline(d, "a slope of h is not finite");
        if (change > d->scales[row])
            d->scales[row] = change;
        t->change[row] = change;
        t->known[row] = 1;
    }
}

static void all_rows(decision *d, tangent_plane *t)
{
    int *unknown = ARRAY(d, int, d->rows), count = 0;
    for (int row = 0; row < d->rows; row++)
        if (!t->known[row])
            unknown[count++] = row;
    compute_rows(d, t, unknown, count);
}

/* ---- the quadratic program ---- */

static double distance(const decision *d, const double *action, const double *other)
{
    double total = 0.0;
    for (int i = 0; i < d->set->actions; i++) {
        const double share = (action[i] - other[i]) / d->set->width[i];
        total += d->set->weight[i] * (share * share);
    }
    return total;
}

typedef enum { NOT_RUN, NOT_NEEDED, SOLVED } solver_status;

/* The minimiser for A (m, actions), b (m,); declined if it is not proven. */
static solver_status solve_program(
    decision *d, const double *A, const double *b, int count, const double *nominal, double *action)
{
    const decision_settings *set = d->set;
    const int actions = set->actions;
    program_2d *q = &d->program;
    clear_flags();
    double x = (nominal[0] - set->low[0]) / set->width[0], y = 0.0, weight = set->weight[0];
    if (actions > 1)
        y = (nominal[1] - set->low[1]) / set->width[1], weight = set->weight[1];
    begin_program(q, x, y, set->weight[0], weight);
    for (int i = 0; i < count; i++) {
        double scaled[MOST_ACTIONS] = {0.0, 0.0}, limit = b[i], minimum = 0.0, reach = 0.0;
        for (int column = 0; column < actions; column++) {
            const double entry = A[i * actions + column], change = entry * set->width[column];
            limit -= entry * set->low[column];
            scaled[column] = change;
            if (change < 0.0)
                minimum += change, reach -= change;
            else
                reach += change;
        }
        if (limit - limit != 0.0 || reach - reach != 0.0)
            decline(d, "numbers not finite");
        if (minimum < limit && reach > 0.0) {
            const double inverse = 1.0 / reach;
            if (inverse - inverse != 0.0)
                continue;
            limit *= inverse;
            add_row(q, scaled[0] * inverse, actions > 1 ? scaled[1] * inverse : 0.0, limit < BEYOND ? limit : BEYOND);
        }
    }
    if (q->count == BOUNDS) {
        clip_action(set, nominal, action);
        return NOT_NEEDED;
    }
    /* Python raises for a division by zero */
    if ((!solve_hard(q) && !solve_soft(q)) || odd_numbers())
        decline(d, "the quadratic program needs the general solver");
    action[0] = q->x == 1.0 ? set->high[0] : set->low[0] + set->width[0] * q->x;
    if (actions > 1)
        action[1] = q->y == 1.0 ? set->high[1] : set->low[1] + set->width[1] * q->y;
    return SOLVED;
}

/* Solves the program of the linearised constraints; writes the action, clipped to its bounds. */
static solver_status solve_linearized(
    decision *d, tangent_plane *t, const candidate *about, double overshoot, const double *nominal, double *action)
{
    const int actions = d->set->actions, rows = d->rows;
    int *near = ARRAY(d, int, rows), *unknown = ARRAY(d, int, rows), count = 0, missing = 0;
    double *A = ARRAY(d, double, rows * actions), *b = ARRAY(d, double, rows), found[MOST_ACTIONS];
    for (int row = 0; row < rows; row++)
        if (!(about->residual[row] > t->reach)) {
            near[count++] = row;
            if (!t->known[row])
                unknown[missing++] = row;
        }
    compute_rows(d, t, unknown, missing);
    for (int i = 0; i < count; i++) {
        const int row = near[i];
        const double residual = about->residual[row];
        double limit = MARK * t->change[row] - residual;
        if (residual < 0.0)
            limit -= overshoot * residual;
        for (int column = 0; column < actions; column++) {
            A[i * actions + column] = t->row[row * actions + column];
            limit += t->row[row * actions + column] * about->action[column];
        }
        b[i] = limit;
    }
    const solver_status status = solve_program(d, A, b, count, nominal, found);
    if (!all_finite(found, actions))
        decline(d, "the program's action is not finite");
    clip_action(d->set, found, action);
    return status;
}

/* ---- sequential quadratic programming ---- */

static double shortfall_of(double residual) { return residual < 0.0 ? -residual : 0.0; }

static double tighten(int solutions, double last, double shortfall)
{
    const double more = OVERSHOOT * solutions, left = last > 0.0 ? shortfall / last : 0.0;
    const double kept = last > 0.0 && MOST_LEFT < left ? MOST_LEFT : left;
    const double asked = 1.25 * kept / (1.0 - kept);
    return asked > more ? asked : more;
}

static int is_repeated(const decision *d, const candidate *one, const candidate *other)
{
    for (int i = 0; i < d->set->actions; i++)
        if (!(size_of(one->action[i] - other->action[i]) <= SAME * d->set->width[i]))
            return 0;
    return 1;
}

static candidate *pick_better(const decision *d, const double *nominal, candidate *one, candidate *other)
{
    if (one->feasible && other->feasible)
        return distance(d, other->action, nominal) < distance(d, one->action, nominal) ? other : one;
    if (one->feasible || other->feasible)
        return one->feasible ? one : other;
    return min_scaled_residual(d, other) > min_scaled_residual(d, one) ? other : one;
}

static candidate *iterate(
    decision *d, const double *nominal, candidate *start, int rounds, candidate **before, solver_status *status)
{
    candidate *best = start, *about = start;
    tangent_plane *tangent = linearize(d, start);
    int fresh = 1;
    double shortfall = shortfall_of(min_scaled_residual(d, start)), overshoot = 0.0, action[MOST_ACTIONS];
    *before = start, *status = NOT_RUN;
    for (int index = 0; index < rounds; index++) {
        *status = solve_linearized(d, tangent, about, overshoot, nominal, action);
        *before = about;
        about = evaluate(d, action);
        best = index == 0 ? about : pick_better(d, nominal, best, about);
        const double least = min_scaled_residual(d, about);
        if (about->feasible && least <= NEEDLESS)
            break;
        if (best->feasible && !about->feasible)
            break;
        if (fresh && is_repeated(d, about, *before))
            break;
        const double last = shortfall;
        shortfall = shortfall_of(least);
        fresh = !(0.0 < shortfall && shortfall < SERVED_WELL * last);
        overshoot = tighten(index + 1, last, shortfall);
        if (fresh && index + 1 < rounds)
            tangent = linearize(d, about);
    }
    return best;
}

static double feasible_share(const decision *d, const candidate *feasible, const candidate *infeasible)
{
    double share = 1.0;
    for (int row = 0; row < d->rows; row++) {
        const double here = feasible->residual[row], there = infeasible->residual[row];
        if (there < 0.0) {
            const double room = here > 0.0 ? here / (here - there) : 0.0;
            share = room < share ? room : share;
        }
    }
    return share;
}

static candidate *line_search(decision *d, candidate *last, candidate *feasible)
{
    if (last->feasible)
        return last;
    const candidate *end = last;
    candidate *safe = feasible;
    double low = 0.0, high = 1.0, between[MOST_ACTIONS];
    for (int i = 0; i < TRIES; i++) {
        const double allowed = (high - low) * feasible_share(d, safe, last);
        if (allowed <= NEAR)
            break;
        const double share = low + LEFT * allowed;
        for (int j = 0; j < d->set->actions; j++)
            between[j] = feasible->action[j] + share * (end->action[j] - feasible->action[j]);
        candidate *trial = evaluate(d, between);
        if (trial->feasible)
            safe = trial, low = share;
        else
            last = trial, high = share;
    }
    return safe;
}

static void undo_largest_change(const decision *d, const double *target, const double *found, double *back)
{
    double most = -1.0;
    int entry = 0;
    for (int i = 0; i < d->set->actions; i++) {
        double other[MOST_ACTIONS];
        memcpy(other, found, sizeof(double) * (size_t)d->set->actions);
        other[i] = target[i];
        const double cost = distance(d, other, found);
        if (cost > most)
            most = cost, entry = i;
    }
    memcpy(back, found, sizeof(double) * (size_t)d->set->actions);
    back[entry] = target[entry];
}

static candidate *solve_sqp(decision *d, const double *nominal, candidate *start, int rounds, solver_status *status)
{
    candidate *before, *nearer, *ignored;
    candidate *best = iterate(d, nominal, start, rounds, &before, status);
    double clipped[MOST_ACTIONS], back[MOST_ACTIONS];
    solver_status again;
    if (!best->feasible)
        return best;
    clip_action(d->set, nominal, clipped);
    const double room = min_scaled_residual(d, best);
    if (room > NEEDLESS)
        nearer = line_search(d, evaluate(d, clipped), best);
    else if ((room > DOUBTFUL || d->saturated) && distance(d, best->action, nominal) > FAR_AWAY * FAR_AWAY) {
        undo_largest_change(d, clipped, best->action, back);
        nearer = line_search(d, evaluate(d, back), best);
    } else if (before != start && !before->feasible &&
               distance(d, best->action, before->action) > FAR_AWAY * FAR_AWAY)
        return line_search(d, before, best);
    else
        return best;
    if (nearer == best)
        return best;
    return pick_better(d, nominal, nearer, iterate(d, nominal, nearer, 1, &ignored, &again));
}

static candidate *at_value(decision *d, const candidate *about, int entry, double value)
{
    double action[MOST_ACTIONS];
    memcpy(action, about->action, sizeof action);
    action[entry] = value;
    return evaluate(d, action);
}

static candidate *backtrack_entry(decision *d, int entry, double target, candidate *feasible)
{
    const double start = feasible->action[entry];
    double low = BACK_STEP * d->set->width[entry] / size_of(target - start), high = 1.0;
    candidate *best = at_value(d, feasible, entry, start + low * (target - start));
    if (!best->feasible)
        return feasible;
    for (int i = 0; i < HALVINGS; i++) {
        const double share = 0.5 * (low + high);
        candidate *trial = at_value(d, feasible, entry, start + share * (target - start));
        if (trial->feasible)
            best = trial, low = share;
        else
            high = share;
    }
    return best;
}

static candidate *backtrack(decision *d, const double *nominal, candidate *feasible)
{
    double target[MOST_ACTIONS], away[MOST_ACTIONS];
    int order[MOST_ACTIONS], count = 0;
    clip_action(d->set, nominal, target);
    for (int i = 0; i < d->set->actions; i++) {
        away[i] = (feasible->action[i] - target[i]) / d->set->width[i];
        if (away[i] > BACK_STEP || away[i] < -BACK_STEP)
            order[count++] = i;
    }
    /* the furthest first; of equal ones the earlier */
    if (count == 2 && size_of(away[1]) > size_of(away[0]))
        order[0] = 1, order[1] = 0;
    for (int i = 0; i < count; i++)
        feasible = backtrack_entry(d, order[i], target[order[i]], feasible);
    return feasible;
}

/* Moves each entry back to the nominal action as far as the constraints allow. */
static candidate *finish_feasible(decision *d, candidate *found)
{
    solver_status ignored;
    candidate *back = backtrack(d, d->nominal, found);
    if (back == found)
        return found;
    candidate *again = solve_sqp(d, d->nominal, back, 1, &ignored);
    return again->feasible && distance(d, again->action, d->nominal) < distance(d, back->action, d->nominal) ? again
                                                                                                            : back;
}

static candidate *restart_from(
    decision *d, candidate *const *known, int count, solver_status *status)
{
    candidate *nearest[MOST_CORNERS];
    int feasible = 0;
    /* sorted by distance; of equal ones the earlier */
    for (int i = 0; i < count; i++) {
        if (!known[i]->feasible)
            continue;
        const double away = distance(d, known[i]->action, d->nominal);
        int place = feasible++;
        for (; place > 0 && away < distance(d, nearest[place - 1]->action, d->nominal); place--)
            nearest[place] = nearest[place - 1];
        nearest[place] = known[i];
    }
    if (!feasible) {
        candidate *best = known[0];
        double most = min_scaled_residual(d, best);
        for (int i = 1; i < count; i++) {
            const double least = min_scaled_residual(d, known[i]);
            if (least > most)
                most = least, best = known[i];
        }
        return solve_sqp(d, d->nominal, best, d->set->rounds, status);
    }
    candidate *best = nearest[0];
    *status = NOT_NEEDED;
    for (int i = 0; i < feasible && i < STARTS; i++) {
        solver_status solver;
        candidate *nearer = line_search(d, d->nominal_candidate, nearest[i]);
        candidate *found = solve_sqp(d, d->nominal, nearer, d->set->rounds, &solver);
        candidate *const both[2] = {nearer, found};
        for (int j = 0; j < 2; j++)
            if (both[j]->feasible && distance(d, both[j]->action, d->nominal) < distance(d, best->action, d->nominal))
                best = both[j], *status = solver;
    }
    return best;
}

/* ---- candidates ---- */

static int grid_values(const decision_settings *set, int entry, int points, double *values)
{
    for (int i = 0; i < points - 1; i++)
        values[i] = set->low[entry] + set->width[entry] * i / (points - 1);
    values[points - 1] = set->high[entry];
    return points;
}

static int evaluate_grid(decision *d, candidate **grid)
{
    double first[9], second[9], action[MOST_ACTIONS];
    const int points = d->set->affine ? 2 : d->set->actions == 1 ? 9 : 5;
    int count = 0;
    grid_values(d->set, 0, points, first);
    if (d->set->actions > 1)
        grid_values(d->set, 1, points, second);
    for (int i = 0; i < points; i++)
        for (int j = 0; j < (d->set->actions > 1 ? points : 1); j++) {
            action[0] = first[i], action[1] = second[d->set->actions > 1 ? j : 0];
            grid[count++] = evaluate(d, action);
        }
    return count;
}

/* `action` with each entry moved down and up by a share of its range; evaluated. */
static int evaluate_around(decision *d, const double *about, double share, candidate **found)
{
    int count = 0;
    for (int i = 0; i < d->set->actions; i++)
        for (int sign = -1; sign < 2; sign += 2) {
            double moved[MOST_ACTIONS], action[MOST_ACTIONS];
            memcpy(moved, about, sizeof(double) * (size_t)d->set->actions);
            moved[i] = about[i] + (sign < 0 ? -share * d->set->width[i] : share * d->set->width[i]);
            clip_action(d->set, moved, action);
            if (action[i] != about[i])
                found[count++] = evaluate(d, action);
        }
    return count;
}

static candidate *coordinate_search(decision *d, candidate *const *known, int count)
{
    candidate *best = known[0], *around[2 * MOST_ACTIONS];
    double most = min_scaled_residual(d, best);
    solver_status ignored;
    for (int i = 1; i < count; i++) {
        const double least = min_scaled_residual(d, known[i]);
        if (least > most)
            most = least, best = known[i];
    }
    for (int share = 0; share < SHARES && !best->feasible; share++) {
        const int tried = evaluate_around(d, best->action, STEP_SHARES[share], around);
        for (int i = 0; i < tried; i++)
            if (min_scaled_residual(d, around[i]) > most)
                best = around[i], most = min_scaled_residual(d, best);
    }
    if (best->feasible)
        return best;
    double about[MOST_ACTIONS];
    memcpy(about, best->action, sizeof about);
    return solve_sqp(d, about, best, 2, &ignored);
}
