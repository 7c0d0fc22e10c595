// SPDX-License-Identifier: GPL-3.0-or-later
// A surface of which only the depth counts.
void main()
{
  gl_Position = transform * vec4(position, 1.0);
}
