/* The least-violation action: a lexicographic max-min search. The same algorithm as safety/solver/least_violation.py,
   in the same order. */

static const double TOLERANCE = 2e-3, ROW_ROUNDING = 1e-12, MIN_TOLERANCE = 5e-6, ACCURACY = 1e-6;
static const double BACKTRACK_SHARES[2] = {0.5, 0.125};
enum { MAX_ASCENTS = 4, MAX_LEVELS = 4, MIN_SAMPLES = 5, MOST_SCORED = 128 };

typedef struct {
    candidate *of;
    double *scaled_h, level, violation;
} scored;

typedef struct {
    decision *d;
    int safe, count, uncontrollable_count;
    int *rows, *uncontrollable;
    double *scales, *tolerances, *targets, *levels;
    double max_tolerance, fixed_level, level_now, nominal[MOST_ACTIONS];
} violation_search;

static double larger(double first, double second) { return second > first ? second : first; }
static double smaller(double first, double second) { return second < first ? second : first; }

static double relax(const violation_search *v, double value, double tolerance)
{
    if (-ACCURACY < value && value <= 0.0)
        return value;
    const double bound = smaller(value, v->level_now) - MIN_TOLERANCE * tolerance;
    double lowered = value - tolerance;
    if (value >= 0.0 && lowered < 0.0)
        lowered = 0.0;
    return larger(lowered, bound);
}

static void measure_reach(decision *d, candidate *const *known, int count, double *reach)
{
    const int rows = d->rows, actions = d->set->actions, corners = 1 << actions;
    for (int row = 0; row < rows; row++) {
        double low = INFINITY, high = -INFINITY;
        for (int i = 0; i < count; i++) {
            const double value = known[i]->h[row];
            low = value < low ? value : low;
            high = value > high ? value : high;
        }
        reach[row] = high - low;
    }
    if (count >= (MIN_SAMPLES > corners ? MIN_SAMPLES : corners))
        return;
    tangent_plane *t = linearize(d, known[0]);
    all_rows(d, t);
    for (int row = 0; row < rows; row++) {
        double change = 0.0;
        for (int column = 0; column < actions; column++)
            change += size_of(t->row[row * actions + column]) * d->set->width[column];
        reach[row] = larger(reach[row], change);
    }
}

static void split_rows(violation_search *v, const candidate *one, const double *reach)
{
    const decision *d = v->d;
    for (int row = 0; row < d->rows; row++) {
        const double base = d->base_scales[row], size = larger(base, size_of(one->h[row]));
        const int moved = reach[row] > ROW_ROUNDING * size;
        const double scale = moved ? larger(base, reach[row]) : size;
        const double tolerance = larger(TOLERANCE * reach[row] / scale, ROW_ROUNDING);
        v->max_tolerance = larger(v->max_tolerance, tolerance);
        if (moved) {
            v->rows[v->count] = row;
            v->scales[v->count] = scale;
            v->tolerances[v->count] = tolerance;
            v->targets[v->count++] = d->rhs[row] / scale;
            v->level_now = smaller(v->level_now, d->h_now[row] / scale);
            continue;
        }
        v->fixed_level = smaller(v->fixed_level, one->h[row] / scale);
        if (d->h_now[row] < 0.0 || one->residual[row] < -ROW_ROUNDING * scale)
            v->uncontrollable[v->uncontrollable_count++] = row;
    }
}

static scored *score(violation_search *v, candidate *one)
{
    scored *s = ARRAY(v->d, scored, 1);
    double smallest = INFINITY, violation = 0.0;
    s->of = one;
    s->scaled_h = ARRAY(v->d, double, v->count);
    for (int i = 0; i < v->count; i++) {
        const int row = v->rows[i];
        const double scale = v->scales[i], rest = one->residual[row];
        double value = one->h[row] / scale, cap = v->targets[i];
        cap = v->fixed_level > cap ? v->fixed_level : cap;
        value = value > cap ? cap : value;
        s->scaled_h[i] = value;
        smallest = value < smallest ? value : smallest;
        if (rest < 0.0)
            violation -= rest / scale;
    }
    s->level = smallest, s->violation = violation;
    return s;
}

static int is_done(const violation_search *v, const scored *one) { return v->safe && one->of->feasible; }

static scored *max_level(const violation_search *v, scored *const *others, int count)
{
    double top = -INFINITY, fewest = INFINITY;
    for (int i = 0; i < count; i++) {
        if (is_done(v, others[i]))
            return others[i];
        top = others[i]->level > top ? others[i]->level : top;
    }
    for (int i = 0; i < count; i++)
        if (others[i]->level >= top - ACCURACY)
            fewest = smaller(fewest, others[i]->violation);
    for (int i = 0; i < count; i++)
        if (others[i]->level >= top - ACCURACY && others[i]->violation <= fewest + ACCURACY)
            return others[i];
    return others[0];
}

static int reach_levels(const violation_search *v, const double *scaled_h, const double *levels)
{
    for (int i = 0; i < v->count; i++)
        if (scaled_h[i] < levels[i])
            return 0;
    return 1;
}

static scored *select_best(const violation_search *v, scored *const *others, int count)
{
    int among_feasible = 0;
    double top = -INFINITY, fewest = INFINITY, nearest = INFINITY;
    scored *best = NULL;
    for (int i = 0; i < count; i++)
        among_feasible = among_feasible || (v->safe && others[i]->of->feasible);
#define COMPARED(i) (!among_feasible || others[i]->of->feasible)
    for (int i = 0; i < count; i++)
        if (COMPARED(i))
            top = larger(top, others[i]->level);
    for (int i = 0; i < v->count; i++)
        v->levels[i] = relax(v, top, v->tolerances[i]);
    for (int i = 0; i < count; i++)
        if (COMPARED(i) && reach_levels(v, others[i]->scaled_h, v->levels)) {
            best = best ? best : others[i];
            fewest = smaller(fewest, others[i]->violation);
        }
    if (!best)
        decline(v->d, "no candidate reaches the levels");
    const double limit = fewest + v->max_tolerance;
    for (int i = 0; i < count; i++)
        if (COMPARED(i) && others[i]->violation <= limit && reach_levels(v, others[i]->scaled_h, v->levels)) {
            const double away = distance(v->d, others[i]->of->action, v->nominal);
            if (away < nearest)
                best = others[i], nearest = away;
        }
#undef COMPARED
    return best;
}

static double gain(const violation_search *v, const scored *about, const scored *best)
{
    const double higher = best->level - about->level, fewer = about->violation - best->violation;
    return isfinite(higher) ? larger(higher, fewer) / v->max_tolerance : 0.0;
}

static void linear_values(
    const violation_search *v, const double *gradients, const double *offsets, const double *u, double *reached)
{
    const int actions = v->d->set->actions;
    for (int i = 0; i < v->count; i++) {
        double value = offsets[i];
        for (int column = 0; column < actions; column++)
            value += gradients[i * actions + column] * u[column];
        reached[i] = value;
    }
}

static void maximin(
    const violation_search *v, const double *gradients, const double *offsets, const double *levels, double *u)
{
    decision *d = v->d;
    const int actions = d->set->actions;
    double *lowest = ARRAY(d, double, v->count), most = INFINITY;
    for (int i = 0; i < v->count; i++) {
        double maximum = offsets[i];
        lowest[i] = offsets[i];
        for (int column = 0; column < actions; column++) {
            const double entry = gradients[i * actions + column];
            if (entry < 0.0)
                lowest[i] += entry;
            else
                maximum += entry;
        }
        if (isnan(levels[i]) && maximum < most)
            most = maximum;
    }
    max_min *p = &d->lp;
    p->actions = actions, p->count = 0, p->sum = 0.0;
    for (int i = 0; i < v->count; i++)
        if (lowest[i] <= (isnan(levels[i]) ? most : levels[i]))
            add_max_min_row(p, gradients + i * actions, offsets[i], levels[i]);
    clear_flags();
    if (!p->count || !solve_max_min(p, &d->program, u) || odd_numbers())
        decline(d, "the max-min program needs the general solver");
}

/* u (actions,) and the levels (rows,) to hold: the maximum first, then the constraints; 0: there are no rows. */
static int find_levels(
    const violation_search *v, const double *gradients, const double *offsets, double *u, double *levels)
{
    const int count = v->count;
    double *reached = ARRAY(v->d, double, count), *floors = ARRAY(v->d, double, count);
    if (!count)
        return 0;
    for (int i = 0; i < count; i++)
        levels[i] = NAN;
    for (int round = 0; round < MAX_LEVELS; round++) {
        double smallest = INFINITY;
        int left = 0;
        maximin(v, gradients, offsets, levels, u);
        linear_values(v, gradients, offsets, u, reached);
        for (int i = 0; i < count; i++)
            if (isnan(levels[i]))
                smallest = smaller(smallest, reached[i]);
        const double lowest = smaller(v->fixed_level, smallest);
        for (int i = 0; i < count && !round; i++) {
            const double most = smallest <= 0.0 ? v->tolerances[i] : smaller(v->tolerances[i], smallest);
            floors[i] = relax(v, lowest, 0.5 * most);
        }
        for (int i = 0; i < count; i++) {
            if (!isnan(levels[i]))
                continue;
            const double most = smallest <= 0.0 ? v->tolerances[i] : smaller(v->tolerances[i], smallest);
            if (reached[i] <= smallest + 0.5 * most) {
                double level = relax(v, smallest, 0.5 * most);
                if (round || v->fixed_level <= smallest)
                    level = smaller(level, v->targets[i]);
                levels[i] = larger(level, floors[i]);
            } else if (reached[i] < v->targets[i])
                left = 1;
        }
        if (!left)
            break;
    }
    for (int i = 0; i < count; i++)
        if (isnan(levels[i]))
            levels[i] = smaller(larger(v->targets[i], floors[i]), reached[i]);
    return 1;
}

static double prediction_error(const violation_search *v, const double *scaled_h, const candidate *found)
{
    double most = 0.0;
    for (int i = 0; i < v->count; i++) {
        const double error = size_of(found->h[v->rows[i]] / v->scales[i] - scaled_h[i]);
        most = error > most ? error : most;
    }
    return most;
}

/* Actions with their predicted scaled h: the max-min action, then the nearest one that reaches its levels. */
static int propose(violation_search *v, candidate *about, double (*actions_found)[MOST_ACTIONS], double **predicted)
{
    decision *d = v->d;
    const decision_settings *set = d->set;
    const int actions = set->actions, count = v->count;
    tangent_plane *t = linearize(d, about);
    double *gradients = ARRAY(d, double, count * actions), *offsets = ARRAY(d, double, count);
    double *A = ARRAY(d, double, count * actions), *b = ARRAY(d, double, count), *levels = ARRAY(d, double, count);
    double u[MOST_ACTIONS], action[MOST_ACTIONS], shares[MOST_ACTIONS];
    if (count)
        all_rows(d, t);
    for (int i = 0; i < count; i++) {
        const int row = v->rows[i];
        double offset = about->h[row] / v->scales[i];
        for (int column = 0; column < actions; column++) {
            const double step = t->row[row * actions + column] * set->width[column] / v->scales[i];
            offset -= step * ((about->action[column] - set->low[column]) / set->width[column]);
            gradients[i * actions + column] = step;
        }
        offsets[i] = offset;
    }
    if (!find_levels(v, gradients, offsets, u, levels))
        return 0;
    for (int column = 0; column < actions; column++)
        action[column] = set->low[column] + set->width[column] * u[column];
    clip_action(set, action, actions_found[0]);
    predicted[0] = ARRAY(d, double, count);
    linear_values(v, gradients, offsets, u, predicted[0]);
    for (int i = 0; i < count; i++) {
        double limit = levels[i] - offsets[i];
        for (int column = 0; column < actions; column++) {
            const double entry = gradients[i * actions + column] / set->width[column];
            A[i * actions + column] = entry;
            limit += entry * set->low[column];
        }
        b[i] = limit;
    }
    solve_program(d, A, b, count, v->nominal, action);
    clip_action(set, action, actions_found[1]);
    for (int column = 0; column < actions; column++)
        shares[column] = (actions_found[1][column] - set->low[column]) / set->width[column];
    predicted[1] = ARRAY(d, double, count);
    linear_values(v, gradients, offsets, shares, predicted[1]);
    return 2;
}

/* A better candidate than `about`, or itself, and whether the linearisation predicted it. */
static scored *improve(violation_search *v, scored *about, int *exact)
{
    decision *d = v->d;
    double actions[2][MOST_ACTIONS], *predicted[2];
    const int proposals = propose(v, about->of, actions, predicted);
    scored *best = about;
    int as_predicted = 1;
    for (int i = 0; i < proposals; i++) {
        scored *found = score(v, evaluate(d, actions[i]));
        const int accurate = prediction_error(v, predicted[i], found->of) <= ACCURACY;
        as_predicted = as_predicted && accurate;
        scored *compared[3] = {best, found, NULL};
        scored *better = select_best(v, compared, 2);
        if (better != found && !accurate) {
            compared[0] = better;
            for (int j = 0; j < 2; j++) {
                double between[MOST_ACTIONS];
                for (int column = 0; column < d->set->actions; column++)
                    between[column] = about->of->action[column] +
                        BACKTRACK_SHARES[j] * (found->of->action[column] - about->of->action[column]);
                compared[1 + j] = score(v, evaluate(d, between));
            }
            better = select_best(v, compared, 3);
        }
        best = better;
    }
    *exact = as_predicted && proposals > 0;
    return best;
}

static scored *ascend(violation_search *v, scored *best, int *exact)
{
    *exact = 0;
    for (int i = 0; i < MAX_ASCENTS && !is_done(v, best); i++) {
        scored *about = best;
        best = improve(v, about, exact);
        if (*exact || best == about || gain(v, about, best) < 1.0)
            break;
    }
    return best;
}

static scored *search_levels(violation_search *v, scored *const *known, int count)
{
    scored *all[MOST_SCORED], *compared[2 * MOST_ACTIONS + 1];
    candidate *around[2 * MOST_ACTIONS];
    int exact, found = 1;
    scored *best = ascend(v, select_best(v, known, count), &exact);
    if (exact && v->d->set->affine)
        return best;
    all[0] = best;
    scored *from = best;
    for (int share = 0; share < SHARES && !is_done(v, from); share++) {
        const int tried = evaluate_around(v->d, from->of->action, STEP_SHARES[share], around);
        compared[0] = from;
        for (int i = 0; i < tried; i++)
            compared[1 + i] = all[found++] = score(v, around[i]);
        from = max_level(v, compared, tried + 1);
    }
    scored *upper = max_level(v, all, found);
    if (upper != best && gain(v, best, upper) >= 1.0)
        all[found++] = ascend(v, upper, &exact);
    return select_best(v, all, found);
}

/* The least-violation candidate; `known` begins with the backup. Writes rows that no action influences. */
static candidate *least_violation(
    decision *d, candidate *const *known, int count, int **uncontrollable, int *uncontrollable_count)
{
    const int rows = d->rows;
    violation_search *v = ARRAY(d, violation_search, 1);
    scored *all[MOST_SCORED];
    double *reach = ARRAY(d, double, rows);
    *v = (violation_search){.d = d, .safe = d->min_h_now >= 0.0, .max_tolerance = ROW_ROUNDING,
                            .fixed_level = INFINITY, .level_now = INFINITY};
    v->rows = ARRAY(d, int, rows), v->uncontrollable = ARRAY(d, int, rows);
    v->scales = ARRAY(d, double, rows), v->tolerances = ARRAY(d, double, rows);
    v->targets = ARRAY(d, double, rows), v->levels = ARRAY(d, double, rows);
    measure_reach(d, known, count, reach);
    split_rows(v, known[0], reach);
    memcpy(v->nominal, v->uncontrollable_count ? known[0]->action : d->nominal, sizeof v->nominal);
    *uncontrollable = v->uncontrollable, *uncontrollable_count = v->uncontrollable_count;
    for (int i = 0; i < count; i++)
        all[i] = score(v, known[i]);
    scored *best = search_levels(v, all, count);
    if (isfinite(v->fixed_level) && best->violation > ACCURACY) {
        v->fixed_level = INFINITY;
        all[0] = score(v, best->of);
        for (int i = 0; i < count; i++)
            all[i + 1] = score(v, known[i]);
        best = search_levels(v, all, count + 1);
    }
    return best->of;
}
