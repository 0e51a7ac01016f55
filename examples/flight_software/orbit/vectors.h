/* Vectors and quaternions (scalar first) for the flight computer. */
#ifndef VECTORS_H
#define VECTORS_H

#include <math.h>

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double norm(const double a[3])
{
    return sqrt(dot(a, a));
}

static void cross(const double a[3], const double b[3], double out[3])
{
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    out[0] = x;
    out[1] = y;
    out[2] = z;
}

/* out = a + k b; out may be a or b. */
static void add_scaled(const double a[3], double k, const double b[3], double out[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        out[i] = a[i] + k * b[i];
    }
}

static void unit(double a[3])
{
    const double length = norm(a);
    int i;
    for (i = 0; i < 3; ++i) {
        a[i] /= length > 0.0 ? length : 1.0;
    }
}

static void product(const double a[4], const double b[4], double out[4])
{
    const double w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    const double x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    const double y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    const double z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    out[0] = w;
    out[1] = x;
    out[2] = y;
    out[3] = z;
}

static void conjugate(const double q[4], double out[4])
{
    out[0] = q[0];
    out[1] = -q[1];
    out[2] = -q[2];
    out[3] = -q[3];
}

/* Turn q, a frame to another, by a small rotation vector in its own frame. */
static void turn(double q[4], const double by[3])
{
    const double half = 0.5 * norm(by), k = half > 1e-12 ? 0.5 * sin(half) / half : 0.5;
    const double step[4] = {cos(half), k * by[0], k * by[1], k * by[2]};
    double length;
    int i;
    product(q, step, q);
    length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (i = 0; i < 4; ++i) {
        q[i] /= length;
    }
}

/* Components in the outer frame of a vector in the frame of q. */
static void rotate(const double q[4], const double a[3], double out[3])
{
    double t[3], s[3];
    cross(q + 1, a, t);
    cross(q + 1, t, s);
    add_scaled(a, 2.0 * q[0], t, t);
    add_scaled(t, 2.0, s, out);
}

/* Rotate by an angle about z. */
static void about_z(double angle, const double a[3], double out[3])
{
    const double c = cos(angle), s = sin(angle), x = c * a[0] - s * a[1], y = s * a[0] + c * a[1];
    out[0] = x;
    out[1] = y;
    out[2] = a[2];
}

#endif
