#define _POSIX_C_SOURCE 200809L
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <setjmp.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* The two programs of a decision for one or two actions: the nearest action under linear constraints, and the max-min
   linear program. The same algorithms as safety/solver/active_set_2d.py, qp_scaling.py and maximin_lp.py, in the same
   order, so that the results have the same bits. Where those need the general solver, these functions report failure. */

enum { BOUNDS = 4, MAX_ACTIVE = 8, MAX_STEPS = 32, MAX_PIVOTS = 32 };

static const double QP_FEASIBLE = 1e-12, QP_PARALLEL = 1e-9, LINEAR_PRICE = 1e4, QUADRATIC_PRICE = 1e5;
static const double MIN_STEP = 1e-10, PRICE_TOLERANCE = 1e-9, MIN_WEIGHT = 1e-6, PARALLEL_COSINE = 1e-12;

typedef struct {
    double nominal_x, nominal_y, weight_x, weight_y, sum, x, y;
    double *a, *b, *limit;
    unsigned char *violated;
    int count;
    /* of the program with slack */
    int first, second;
    double down_x, down_y, xx, xy, yy;
} program_2d;

static double size_of(double value) { return fabs(value); }

static void begin_program(program_2d *q, double x, double y, double weight_x, double weight_y)
{
    static const double a[BOUNDS] = {1.0, -1.0, 0.0, 0.0}, b[BOUNDS] = {0.0, 0.0, 1.0, -1.0};
    static const double limit[BOUNDS] = {0.0, -1.0, 0.0, -1.0};
    memcpy(q->a, a, sizeof a);
    memcpy(q->b, b, sizeof b);
    memcpy(q->limit, limit, sizeof limit);
    q->nominal_x = x, q->nominal_y = y, q->weight_x = weight_x, q->weight_y = weight_y;
    q->sum = x + y;
    q->count = BOUNDS;
}

static void add_row(program_2d *q, double a, double b, double limit)
{
    q->a[q->count] = a, q->b[q->count] = b, q->limit[q->count] = limit;
    q->count++;
    q->sum += a + b + limit;
}

/* ---- hard constraints ---- */

static int satisfies_active(const program_2d *q, const int *active, int count)
{
    for (int i = 0; i < count; i++) {
        const int row = active[i];
        if (!(q->limit[row] - q->a[row] * q->x - q->b[row] * q->y <= QP_FEASIBLE))
            return 0;
    }
    return 1;
}

static int project_on_line(program_2d *q, int row)
{
    const double a = q->a[row], b = q->b[row];
    const double along = a / q->weight_x, across = b / q->weight_y;
    const double size = a * along + b * across;
    if (size == 0.0)
        return 0;
    const double share = (q->limit[row] - a * q->nominal_x - b * q->nominal_y) / size;
    if (!(share >= 0.0))
        return 0;
    q->x = q->nominal_x + share * along;
    q->y = q->nominal_y + share * across;
    return 1;
}

static int solve_corner(program_2d *q, int one, int other)
{
    const double a = q->a[one], b = q->b[one], first = q->limit[one];
    const double c = q->a[other], d = q->b[other], second = q->limit[other];
    const double determinant = a * d - b * c;
    if (size_of(determinant) <= QP_PARALLEL * (size_of(a) + size_of(b)) * (size_of(c) + size_of(d)))
        return 0;
    const double x = (first * d - second * b) / determinant, y = (a * second - c * first) / determinant;
    const double pull = 2.0 * q->weight_x * (x - q->nominal_x), push = 2.0 * q->weight_y * (y - q->nominal_y);
    if (!((pull * d - push * c) / determinant >= 0.0))
        return 0;
    if (!((a * push - b * pull) / determinant >= 0.0))
        return 0;
    q->x = x, q->y = y;
    return 1;
}

static int solve_hard(program_2d *q)
{
    int active[MAX_ACTIVE];
    if (q->sum - q->sum != 0.0)
        return 0;
    q->x = q->nominal_x, q->y = q->nominal_y;
    for (int count = 0; count < MAX_ACTIVE; count++) {
        double worst = QP_FEASIBLE;
        int newest = -1;
        for (int row = 0; row < q->count; row++) {
            const double broken = q->limit[row] - q->a[row] * q->x - q->b[row] * q->y;
            if (broken > worst)
                worst = broken, newest = row;
        }
        if (newest < 0)
            return 1;
        int found = project_on_line(q, newest) && satisfies_active(q, active, count);
        for (int i = 0; i < count && !found; i++)
            found = solve_corner(q, active[i], newest) && satisfies_active(q, active, count);
        if (!found)
            return 0;
        active[count] = newest;
    }
    return 0;
}

/* ---- constraints with slack ---- */

static double within_unit(double value)
{
    const double raised = 0.0 > value ? 0.0 : value;
    return 1.0 < raised ? 1.0 : raised;
}

static void update_derivatives(program_2d *q)
{
    double down_x = 2.0 * q->weight_x * (q->nominal_x - q->x), down_y = 2.0 * q->weight_y * (q->nominal_y - q->y);
    double xx = 2.0 * q->weight_x, xy = 0.0, yy = 2.0 * q->weight_y;
    for (int row = BOUNDS; row < q->count; row++)
        if (q->violated[row]) {
            const double a = q->a[row], b = q->b[row];
            const double price = LINEAR_PRICE + 2.0 * QUADRATIC_PRICE * (q->limit[row] - a * q->x - b * q->y);
            down_x += price * a;
            down_y += price * b;
            xx += 2.0 * QUADRATIC_PRICE * a * a;
            xy += 2.0 * QUADRATIC_PRICE * a * b;
            yy += 2.0 * QUADRATIC_PRICE * b * b;
        }
    q->down_x = down_x, q->down_y = down_y, q->xx = xx, q->xy = xy, q->yy = yy;
}

/* Share of the step, change per share and index of the first line before `end`; else `end` and -1. */
static int first_crossing(const program_2d *q, double step_x, double step_y, double end, double *share, double *change)
{
    const double none = PARALLEL_COSINE * (size_of(step_x) + size_of(step_y));
    int line = -1;
    *share = end, *change = 0.0;
    for (int row = 0; row < q->count; row++) {
        if (row == q->first)
            continue;
        const double a = q->a[row], b = q->b[row], rate = a * step_x + b * step_y;
        if (!(size_of(rate) > none * (size_of(a) + size_of(b))) || (rate > 0.0) != q->violated[row])
            continue;
        const double distance = (q->limit[row] - a * q->x - b * q->y) / rate;
        if (distance < *share)
            *share = distance, *change = rate, line = row;
    }
    return line;
}

static void move_along(program_2d *q, double step_x, double step_y)
{
    double derivative = -(q->down_x * step_x + q->down_y * step_y);
    double curvature = step_x * step_x * q->xx + 2.0 * step_x * step_y * q->xy + step_y * step_y * q->yy;
    const double least = 2.0 * (q->weight_x * step_x * step_x + q->weight_y * step_y * step_y);
    double travelled = 0.0, distance, rate;
    int line = -1;
    for (int i = 0; i < q->count + 1; i++) {
        line = first_crossing(q, step_x, step_y, travelled - derivative / curvature, &distance, &rate);
        distance = travelled > distance ? travelled : distance;
        derivative += curvature * (distance - travelled);
        travelled = distance;
        if (line < BOUNDS || derivative + LINEAR_PRICE * size_of(rate) >= 0.0)
            break;
        derivative += LINEAR_PRICE * size_of(rate);
        curvature += 2.0 * QUADRATIC_PRICE * (rate < 0.0 ? rate * rate : -(rate * rate));
        curvature = least > curvature ? least : curvature;
        q->violated[line] = rate < 0.0;
    }
    q->x = within_unit(q->x + travelled * step_x);
    q->y = within_unit(q->y + travelled * step_y);
    if (line < 0)
        return;
    if (line < BOUNDS) {
        const double end = -q->limit[line];
        if (line < 2)
            q->x = end;
        else
            q->y = end;
    }
    q->violated[line] = 0;
    if (q->first < 0)
        q->first = line;
    else
        q->second = line;
}

static int descend(program_2d *q)
{
    double step_x, step_y;
    if (q->second >= 0)
        return 0;
    if (q->first >= 0) {
        const double along = -q->b[q->first], across = q->a[q->first];
        const double curvature = along * along * q->xx + 2.0 * along * across * q->xy + across * across * q->yy;
        const double share = (along * q->down_x + across * q->down_y) / curvature;
        step_x = share * along, step_y = share * across;
    } else {
        const double determinant = q->xx * q->yy - q->xy * q->xy;
        step_x = (q->yy * q->down_x - q->xy * q->down_y) / determinant;
        step_y = (q->xx * q->down_y - q->xy * q->down_x) / determinant;
    }
    if (!(size_of(step_x) + size_of(step_y) > MIN_STEP))
        return 0;
    move_along(q, step_x, step_y);
    return 1;
}

static double exceeds_bounds(double price, int line)
{
    const double excess = line >= BOUNDS ? price - LINEAR_PRICE : 0.0;
    return excess > -price ? excess : -price;
}

static int drop_by_price(program_2d *q, double one, double other)
{
    const double first = exceeds_bounds(one, q->first), second = exceeds_bounds(other, q->second);
    int dropped = q->second;
    double price = other;
    if (!((second > first ? second : first) > PRICE_TOLERANCE))
        return 0;
    if (first >= second) {
        dropped = q->first, price = one;
        q->first = q->second;
    }
    q->second = -1;
    /* one active line alone has no second one: its price 0 is never the worse */
    if (dropped >= 0)
        q->violated[dropped] = price > 0.0;
    return 1;
}

static int drop_from_active_set(program_2d *q)
{
    if (q->first < 0)
        return 0;
    const double a = q->a[q->first], b = q->b[q->first];
    if (q->second < 0)
        return drop_by_price(q, (a * q->down_x + b * q->down_y) / -(a * a + b * b), 0.0);
    const double c = q->a[q->second], d = q->b[q->second], determinant = b * c - a * d;
    const double one = (d * q->down_x - c * q->down_y) / determinant;
    const double other = (a * q->down_y - b * q->down_x) / determinant;
    return drop_by_price(q, one, other);
}

static int solve_soft(program_2d *q)
{
    if (q->sum - q->sum != 0.0 || !(q->weight_x >= MIN_WEIGHT && q->weight_y >= MIN_WEIGHT))
        return 0;
    q->first = q->second = -1;
    q->x = within_unit(q->nominal_x);
    q->y = within_unit(q->nominal_y);
    memset(q->violated, 0, BOUNDS);
    for (int row = BOUNDS; row < q->count; row++)
        q->violated[row] = q->a[row] * q->x + q->b[row] * q->y < q->limit[row];
    for (int i = 0; i < MAX_STEPS; i++) {
        update_derivatives(q);
        if (!descend(q) && !drop_from_active_set(q))
            return q->x - q->x == 0.0 && q->y - q->y == 0.0;
    }
    return 0;
}

/* ---- the max-min linear program ---- */

enum { MOST_Z = 3 };

static const double CENTERING_WEIGHT = 1e-9, LP_FEASIBLE = 1e-12, LP_EQUAL = 1e-9, MIN_PIVOT = 1e-9;

typedef struct {
    int actions, count, bounds;
    double (*rows)[MOST_Z];
    double *limits;
    unsigned char *free;
    int basis[MOST_Z];
    double multipliers[MOST_Z], inverse[MOST_Z][MOST_Z], z[MOST_Z], sum;
} max_min;

static double scaled_violation(const max_min *p, int row)
{
    double violation = p->limits[row];
    for (int place = 0; place <= p->actions; place++)
        violation -= p->rows[row][place] * p->z[place];
    return violation / (1.0 + size_of(p->limits[row]));
}

static void add_max_min_row(max_min *p, const double *gradient, double offset, double level)
{
    const int is_free = level != level;
    for (int column = 0; column < p->actions; column++) {
        p->rows[p->count][column] = gradient[column];
        p->sum += gradient[column];
    }
    p->rows[p->count][p->actions] = is_free ? -1.0 : 0.0;
    p->limits[p->count] = is_free ? -offset : level - offset;
    p->sum += p->limits[p->count];
    p->free[p->count++] = (unsigned char)is_free;
}

static int start_basis(max_min *p)
{
    const int size = p->actions;
    double lowest = 0.0;
    int first = -1;
    for (int row = 0; row < p->bounds; row++) {
        if (!p->free[row])
            continue;
        double maximum = -p->limits[row];
        for (int column = 0; column < size; column++) {
            const double entry = p->rows[row][column];
            maximum += entry > 0.0 ? entry : 0.0;
        }
        if (first < 0 || maximum < lowest)
            lowest = maximum, first = row;
    }
    if (first < 0)
        return 0;
    memset(p->inverse, 0, sizeof p->inverse);
    for (int column = 0; column < size; column++) {
        const int upper = p->rows[first][column] >= 0.0;
        p->basis[column] = p->bounds + 2 * column + upper;
        p->multipliers[column] = size_of(p->rows[first][column]);
        p->inverse[column][column] = upper ? -1.0 : 1.0;
    }
    p->basis[size] = first;
    p->multipliers[size] = 1.0;
    for (int column = 0; column < size; column++)
        p->inverse[size][column] = p->rows[first][column] * p->inverse[column][column];
    p->inverse[size][size] = -1.0;
    return 1;
}

static int pivot(max_min *p, int entering)
{
    const int size = p->actions + 1;
    double changes[MOST_Z], step = 0.0;
    int leaving = -1;
    for (int place = 0; place < size; place++) {
        double change = 0.0;
        for (int row = 0; row < size; row++)
            change += p->rows[entering][row] * p->inverse[row][place];
        changes[place] = change;
        if (change > MIN_PIVOT) {
            const double ratio = p->multipliers[place] / change;
            if (leaving < 0 || ratio < step)
                leaving = place, step = ratio;
        }
    }
    if (leaving < 0)
        return 0;
    for (int row = 0; row < size; row++) {
        double *own = p->inverse[row];
        const double share = own[leaving] / changes[leaving];
        for (int place = 0; place < size; place++)
            own[place] = place == leaving ? share : own[place] - changes[place] * share;
    }
    for (int place = 0; place < size; place++)
        p->multipliers[place] = place == leaving ? step : p->multipliers[place] - step * changes[place];
    p->basis[leaving] = entering;
    return 1;
}

static int holds_with_equality(const max_min *p)
{
    for (int place = 0; place <= p->actions; place++)
        if (!(size_of(scaled_violation(p, p->basis[place])) <= LP_EQUAL))
            return 0;
    return 1;
}

static int is_only_optimum(const max_min *p)
{
    for (int place = 0; place <= p->actions; place++) {
        double multiplier = -p->inverse[p->actions][place];
        for (int column = 0; column < p->actions; column++)
            multiplier += CENTERING_WEIGHT * (p->z[column] - 0.5) * p->inverse[column][place];
        if (!(multiplier >= 0.0))
            return 0;
    }
    return 1;
}

/* Of several optimal u the one nearest to the middle; 0: not proven. */
static int nearest_to_middle(const max_min *p, program_2d *q, double *u)
{
    const int two = p->actions > 1;
    const double t = p->z[p->actions] - LP_FEASIBLE * (1.0 + size_of(p->z[p->actions]));
    begin_program(q, 0.5, two ? 0.5 : 0.0, 1.0, 1.0);
    for (int row = 0; row < p->bounds; row++) {
        const double a = p->rows[row][0], b = two ? p->rows[row][1] : 0.0, size = size_of(a) + size_of(b);
        if (size > 0.0)
            add_row(q, a / size, b / size, (p->free[row] ? p->limits[row] + t : p->limits[row]) / size);
    }
    if (!solve_hard(q))
        return 0;
    u[0] = within_unit(q->x);
    if (two)
        u[1] = within_unit(q->y);
    return 1;
}

/* u (actions,) of the optimum that is proven; 0: there is none. The rows were added before. */
static int solve_max_min(max_min *p, program_2d *q, double *u)
{
    p->bounds = p->count;
    for (int column = 0; column < p->actions; column++)
        for (int side = 0; side < 2; side++) {
            memset(p->rows[p->count], 0, sizeof p->rows[0]);
            p->rows[p->count][column] = side ? -1.0 : 1.0;
            p->limits[p->count++] = side ? -1.0 : 0.0;
        }
    if (p->sum - p->sum != 0.0 || !start_basis(p))
        return 0;
    for (int i = 0; i < MAX_PIVOTS; i++) {
        for (int row = 0; row <= p->actions; row++) {
            double value = 0.0;
            for (int place = 0; place <= p->actions; place++)
                value += p->inverse[row][place] * p->limits[p->basis[place]];
            p->z[row] = value;
        }
        double worst = LP_FEASIBLE;
        int violated = -1;
        for (int row = 0; row < p->count; row++) {
            const double violation = scaled_violation(p, row);
            if (violation > worst)
                worst = violation, violated = row;
        }
        if (violated < 0) {
            for (int column = 0; column < p->actions; column++)
                u[column] = within_unit(p->z[column]);
            return holds_with_equality(p) && (is_only_optimum(p) || nearest_to_middle(p, q, u));
        }
        if (!pivot(p, violated))
            return 0;
    }
    return 0;
}
